"""Transport of bytes between processes: Zenoh or memory, flow control, and access control."""
