"""SLAM as a library: the classes that `ldo_service` exports for use without a service."""
