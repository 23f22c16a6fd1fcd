"""Limits of the browser view."""

from dataclasses import dataclass

from ldo_service.config.service_settings import ViewerSettings
from ldo_service.errors import ConfigError
from ldo_service.transport.endpoint import LOOPBACK


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """Limits of `ldo view`, which protect browser and network from a large map."""

    address: str = LOOPBACK  # The window has no keys: whoever reaches it sees the map.
    port: int = 8080  # The next free port is taken where this is in use; 0 takes any.
    # The weightiest are shown, and a quarter more while a map grows, at 32 bytes each.
    most_gaussians: int = 300_000
    most_poses: int = 20_000  # of a path, 11 minutes of 30 Hz; a longer one is drawn coarser
    most_keyframes: int = 2_000  # of more every second, third, ... is drawn
    most_objects: int = 200  # those seen most: more labels than that hide each other
    update_s: float = 0.2  # between looks at what is new; poses move at 5 Hz
    lines_s: float = 1.0  # between sends of paths, keyframes and boxes: 4 MB at most
    gaussians_s: float = 2.0  # between sends of the Gaussians: 6 MB a second at most

    def __post_init__(self) -> None:
        counts = (self.most_gaussians, self.most_poses, self.most_keyframes, self.most_objects)
        times_s = (self.update_s, self.lines_s, self.gaussians_s)
        if min(counts) < 1 or min(times_s) <= 0 or not 0 <= self.port <= 65535:
            raise ConfigError(
                f"viewer counts {counts} must be at least 1, times {times_s} positive, and port "
                f"{self.port} within 0..65535."
            )


def viewer_config(settings: ViewerSettings) -> ViewerConfig:
    """Return the limits of the view by the section `viewer` of the configuration."""
    return ViewerConfig(
        address=settings.address,
        port=settings.port,
        most_gaussians=settings.max_gaussians,
        update_s=settings.update_interval_s,
    )
