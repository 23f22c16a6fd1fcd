"""Runs over sequences of frames, each with a folder for its results."""
