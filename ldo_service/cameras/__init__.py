"""Adapters from third-party camera software to messages of the topic `camera/rgbd`."""
