"""A run over a file: from a sequence of frames to a folder of results."""
