"""Publication, replication and search of the map."""
