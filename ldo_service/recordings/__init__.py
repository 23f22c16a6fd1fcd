"""Recordings of a service, with the inputs of each actor, and their replay."""
