"""Recordings of the service: written by its stages, replayed actor by actor, run over as data."""
