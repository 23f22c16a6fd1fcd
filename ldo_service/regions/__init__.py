"""Image regions of keyframes, tracked over keyframes until they have a name."""
