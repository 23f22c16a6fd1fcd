"""The map as it is published, replicated and searched."""
