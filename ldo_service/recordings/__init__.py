"""Recordings of a service: the inputs and outputs of each actor on disk, and their replay."""
