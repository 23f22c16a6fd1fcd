"""Limits of what `ldo view` draws in the browser."""

from dataclasses import dataclass

from ldo_service.config.service_settings import ViewerSettings
from ldo_service.errors import ConfigError
from ldo_service.transport.endpoint import LOOPBACK


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """Address and limits of `ldo view`; the limits protect browser and network from large maps."""

    address: str = LOOPBACK  # The window needs no keys: anyone who reaches it can see the map.
    port: int = 8080  # If this port is in use, the next free one is used. 0 uses any free port.
    # Maximum number of drawn Gaussians, 32 bytes each; those that cover the most area with the
    # highest opacity are drawn. While a map grows, up to a quarter more are drawn.
    max_gaussians: int = 300_000
    # Maximum number of poses of a path, 11 minutes at 30 Hz. A longer path is thinned evenly.
    max_poses: int = 20_000
    # Maximum number of drawn keyframes. If there are more, every second, third, ... is drawn.
    max_keyframes: int = 2_000
    # Maximum number of drawn objects. The objects with the most observations are drawn; more names
    # would hide each other.
    max_objects: int = 200
    update_s: float = 0.2  # Interval between updates; the camera thus moves at 5 Hz.
    lines_s: float = 1.0  # Interval between drawings of paths, keyframes and boxes, at most 4 MB.
    gaussians_s: float = 2.0  # Interval between drawings of the Gaussians, at most 6 MB per second.

    def __post_init__(self) -> None:
        counts = (self.max_gaussians, self.max_poses, self.max_keyframes, self.max_objects)
        times_s = (self.update_s, self.lines_s, self.gaussians_s)
        if min(counts) < 1 or min(times_s) <= 0 or not 0 <= self.port <= 65535:
            raise ConfigError(
                f"viewer: the maximum numbers {counts} of Gaussians, poses, keyframes and objects "
                f"must be at least 1. The intervals {times_s} s must be positive. The port "
                f"{self.port} must be within 0..65535."
            )


def viewer_config(settings: ViewerSettings) -> ViewerConfig:
    """Convert viewer settings to a `ViewerConfig`, whose other fields keep their defaults."""
    return ViewerConfig(
        address=settings.address,
        port=settings.port,
        max_gaussians=settings.max_gaussians,
        update_s=settings.update_interval_s,
    )
