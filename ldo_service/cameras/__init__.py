"""Adapters from third-party camera software to frames of `camera/rgbd`."""
