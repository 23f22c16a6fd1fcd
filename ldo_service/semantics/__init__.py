"""Labels of the Gaussians, and the objects among them.

gaussian_labels    label distributions of the Gaussians over time, smoothed among neighbors
label_assignment   which Gaussians a region shows
semantic_fusion    a keyframe's regions, fused into the labels of the map
semantic_map       labels and objects of a map while it grows
distributions      label distributions: means, divergences, entropies
object_landmarks   objects: samples of Gaussians, and what follows from them
data_association   which object a region of a keyframe shows
observations       what a keyframe adds to an object
objects            how objects are proposed, confirmed, merged and removed
semantics_file     labels and objects in a file
text_search        objects that match a text
"""
