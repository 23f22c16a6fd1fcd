"""Every section of the configuration with its defaults, units and reasons."""

import dataclasses
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ldo_service.actors.detector import DetectorConfig
from ldo_service.actors.frame_source import FrameSourceConfig
from ldo_service.actors.loop_closer import LoopCloserConfig
from ldo_service.actors.mapper import MapperConfig
from ldo_service.actors.optimizer import OptimizerConfig
from ldo_service.actors.tracker import TrackerConfig
from ldo_service.actors.vlm_labeller import VlmLabellerConfig
from ldo_service.datasets import SequenceOptions
from ldo_service.errors import ConfigError
from ldo_service.recordings.mcap_file import RecordConfig
from ldo_service.runtime.stage import StageConfig
from ldo_service.transport.endpoint import LOOPBACK, MAX_MESSAGE_MB


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


@dataclass(frozen=True, slots=True)
class ServiceConfig:
    """How the actors of `ldo serve` are run."""

    spawned: tuple[str, ...] = ("optimizer",)  # in processes of their own: gtsam holds the GIL
    drain_s: float = 10.0  # a soft stop waits so long for each stage to finish what it has
    silent_after_s: float = 10.0  # a process without a heartbeat for so long is killed
    sync_state: bool = False  # a step is on the disk before it is told: a power cut costs what a
    # kill does, and each step three syncs, 12 ms on a virtual disk. False: it may cost the state
    control_timeout_s: float = 55.0  # for all actors to obey, each between two steps: the slowest
    # measured is 0.6 s, and a labeller may wait for its server for 50
    keys: str = ""  # folder that `ldo keys add` made, for TLS; --keys names another
    max_message_mb: int = MAX_MESSAGE_MB  # larger ones are dropped; a 4K frame can have 58 MB
    metrics_address: str = LOOPBACK  # who reads them sees when the robot works; 0.0.0.0: everybody

    def __post_init__(self) -> None:
        if self.drain_s < 0 or min(self.silent_after_s, self.control_timeout_s) <= 0:
            raise ConfigError(f"{self}: times must be positive.")
        if not 1 <= self.max_message_mb <= 1000:
            raise ConfigError(f"service.max_message_mb={self.max_message_mb} must be in 1..1000.")


@dataclass(frozen=True, slots=True)
class DataConfig:
    """How data sets are read whose depth and colour come from two cameras (ScanNet, 7-Scenes)."""

    register_depth: bool = False  # bring depth to the colour camera; False: as the files are
    T_color_depth: tuple[float, ...] = ()  # 16 numbers, row-major, metres; empty: the data set's

    def options(self) -> SequenceOptions:
        """Raises ConfigError for numbers that are no rigid transform."""
        if not self.T_color_depth:
            return SequenceOptions(register_depth=self.register_depth)
        if len(self.T_color_depth) != 16:
            raise ConfigError(
                f"data.T_color_depth has {len(self.T_color_depth)} numbers: write the 4x4 matrix "
                "row by row."
            )
        T_color_depth = np.array(self.T_color_depth).reshape(4, 4)
        return SequenceOptions(register_depth=self.register_depth, T_color_depth=T_color_depth)


@dataclass(frozen=True, slots=True)
class RunConfig:
    """How `ldo run` goes over a file."""

    mapper_latency_frames: int = 3  # a keyframe is in the map so many frames later, on any machine
    optimizer_latency_frames: int = 3
    loop_closer_latency_frames: int = 10  # it looks at five places at a time
    detector_latency_frames: int = 3
    vlm_labeller_latency_frames: int = 30  # a second: its answers are late by design
    max_rejected: float = 0.1  # share of unreadable frames over which the data is called bad

    def __post_init__(self) -> None:
        if min(self.latency_frames().values()) < 0:
            raise ConfigError(f"{self}: latencies must be at least 0 frames.")
        if not 0 <= self.max_rejected <= 1:
            raise ConfigError(f"run.max_rejected={self.max_rejected:g} must be within 0..1.")

    def latency_frames(self) -> dict[str, int]:
        """By actor; the others answer within the frame."""
        return {
            "detector": self.detector_latency_frames,
            "loop_closer": self.loop_closer_latency_frames,
            "mapper": self.mapper_latency_frames,
            "optimizer": self.optimizer_latency_frames,
            "vlm_labeller": self.vlm_labeller_latency_frames,
        }


@dataclass(frozen=True, slots=True)
class Config:
    frame_source: FrameSourceConfig = field(default_factory=FrameSourceConfig)
    tracker: TrackerConfig = field(default_factory=TrackerConfig)
    detector: DetectorConfig = field(default_factory=DetectorConfig)
    vlm_labeller: VlmLabellerConfig = field(default_factory=VlmLabellerConfig)
    mapper: MapperConfig = field(default_factory=MapperConfig)
    loop_closer: LoopCloserConfig = field(default_factory=LoopCloserConfig)
    optimizer: OptimizerConfig = field(default_factory=OptimizerConfig)
    data: DataConfig = field(default_factory=DataConfig)
    run: RunConfig = field(default_factory=RunConfig)
    service: ServiceConfig = field(default_factory=ServiceConfig)
    record: RecordConfig = field(default_factory=RecordConfig)
    stage: StageConfig = field(default_factory=StageConfig)
    viewer: ViewerConfig = field(default_factory=ViewerConfig)

    def check_patience(self) -> None:
        """Of a service: nobody may be given up who only waits for a labeller's server.

        Raises ConfigError.
        """
        endpoint = self.vlm_labeller.http.endpoint
        longest_s = endpoint.patience_s + endpoint.timeout_s  # to connect counts anew
        limits = {
            "stage.stall_after_s": self.stage.stall_after_s,
            "service.control_timeout_s": self.service.control_timeout_s,
        }
        for name, limit_s in limits.items():
            if self.vlm_labeller.url and longest_s >= limit_s:
                raise ConfigError(
                    f"vlm_labeller.http.endpoint: patience_s={endpoint.patience_s:g} and "
                    f"timeout_s={endpoint.timeout_s:g} together must be below "
                    f"{name}={limit_s:g}: raise that, or lower these."
                )

    def with_map_folder(self, folder: Path) -> "Config":
        """The mapper keeps images and sleeping Gaussians there, if nowhere else: its successor
        finds them."""
        mapper = dataclasses.replace(self.mapper, folder=self.mapper.folder or str(folder))
        return dataclasses.replace(self, mapper=mapper)
