"""Image regions that may be objects: proposed per keyframe, tracked, and labelled by a labeller."""
