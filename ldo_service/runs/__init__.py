"""Execution of runs over a sequence of frames, which write a folder of results."""
