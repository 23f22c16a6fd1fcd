"""Runs over a sequence of frames, whose results are written to a folder."""
