"""What `ldo view` shows at most, and how often."""

from dataclasses import dataclass

from ldo_service.errors import ConfigError
from ldo_service.transport.endpoint import LOOPBACK


@dataclass(frozen=True, slots=True)
class ViewerConfig:
    """What `ldo view` shows at most, and how often: neither browser nor network is to be flooded,
    whatever the map has."""

    address: str = LOOPBACK  # the window has no keys: who reaches it sees the map
    port: int = 8080  # the next free one where this is taken
    most_gaussians: int = (
        300_000  # the weightiest, and a quarter more while a map grows; 32 bytes each
    )
    most_poses: int = 20_000  # of a path, 11 minutes of 30 Hz; a longer one is drawn coarser
    most_keyframes: int = 2_000  # of more every second, third, ... is drawn
    most_objects: int = 200  # those seen most: more labels than that hide each other
    update_s: float = 0.2  # between looks at what is new; poses move at 5 Hz
    lines_s: float = 1.0  # between sends of paths, keyframes and boxes: 4 MB at most
    gaussians_s: float = 2.0  # between sends of the Gaussians: 6 MB a second at most

    def __post_init__(self) -> None:
        counts = (self.most_gaussians, self.most_poses, self.most_keyframes, self.most_objects)
        if min(counts) < 1 or min(self.update_s, self.lines_s, self.gaussians_s) <= 0:
            raise ConfigError(f"{self}: counts must be at least 1, and times positive.")
        if not 0 <= self.port <= 65535:
            raise ConfigError(f"viewer.port={self.port} must be in 0..65535; 0 takes any free one.")
