"""Labels of the Gaussians and objects of the map.

gaussian_labels    label distributions of the Gaussians over time, smoothed among neighbors
label_assignment   assignment of Gaussians to the regions of a keyframe
semantic_fusion    fusion of a keyframe's regions into the labels of the map
semantic_map       labels and objects of a map while it grows
distributions      label distributions: means, divergences, entropies
object_landmarks   table of objects: a sample of Gaussians for each, and values derived from it
data_association   association of the regions of a keyframe with objects
observations       update of an object from a keyframe
objects            creation, confirmation, merge and removal of objects
semantics_file     file of labels and objects
text_search        search for objects by text
"""
