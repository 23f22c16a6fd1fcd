"""Transport of bytes between actors, over Zenoh or in memory, with flow and access control."""
