"""Actors of the design; each one connects messages (`schemas`) to algorithms (`ldo_service`)."""
