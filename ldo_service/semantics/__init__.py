"""What things are: networks that find and name objects, and the labels of the Gaussians.

vocabulary                class names with stable indices
synonyms                  other words for them, and kinds of them
class_names               what a network calls its classes
network                   an ONNX file, opened and checked
layouts                   how the YOLO family writes boxes
letterbox                 an image within the input of a network, and boxes back in the image
non_maximum_suppression   one box for one object
detectors                 all of these in their order: an image in, boxes out
foreground                the object that fills a box
planes                    what of a keyframe is the room
segments                  what depth, creases and colour set apart from it
assignment                which Gaussians a region shows
fusion                    what detector and labeller say together
labels                    what each Gaussian is, over time
consistency               neighbours that ought to agree
labelling                 all of these in their order: one keyframe
semantic_map              the labels of a map while it grows
saved                     labels in a file
label_images              labels as a camera sees them
distributions             over labels: means, divergences, entropies
landmarks                 objects: samples of Gaussians, and what follows of these
association               which object is which region of a keyframe
search                    which objects somebody means who names a thing
objects                   all of these in their order: how objects come and go
"""
