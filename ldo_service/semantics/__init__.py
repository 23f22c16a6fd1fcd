"""What things are called: networks that find objects, and the names they use.

vocabulary                class names with stable indices
synonyms                  other words for them, and kinds of them
class_names               what a network calls its classes
network                   an ONNX file, opened and checked
layouts                   how the YOLO family writes boxes
letterbox                 an image within the input of a network, and boxes back in the image
non_maximum_suppression   one box for one object
detectors                 all of these in their order: an image in, boxes out
"""
