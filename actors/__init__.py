"""Actors of the service; each one converts messages (`schemas`) and calls the algorithms."""
