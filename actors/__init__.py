"""Actors of the service, each of which handles messages (`schemas`) by calling the algorithms."""
