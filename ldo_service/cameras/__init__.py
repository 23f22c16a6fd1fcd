"""Cameras that somebody else's software speaks to, as frames of `camera/rgbd`."""
