"""Settings of input, offline runs, the service, recordings, supervision and the viewer."""

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from msgspec import Meta

from ldo_service.datasets import SequenceOptions
from ldo_service.errors import ConfigError
from ldo_service.transport.endpoint import LOOPBACK, MAX_MESSAGE_MB

from .values import (
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class FrameSourceSettings:
    """Camera frames."""

    # Color and depth farther apart in time are no pair. Under half a period at 30 Hz the nearest
    # depth is found.
    max_skew_s: Annotated[float, Meta(ge=0, lt=10)] = 0.015


@dataclass(frozen=True, slots=True)
class DatasetSettings:
    """Data sets whose depth and color come from two cameras (ScanNet, 7-Scenes)."""

    # Depth is brought to the color camera. False takes depth as it is in the files.
    register_depth: bool = False
    # These 16 numbers are T_color_depth, row by row, in meters. Empty takes that of the data set.
    T_color_depth: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        if len(self.T_color_depth) not in (0, 16):
            raise ConfigError(
                f"dataset.T_color_depth={list(self.T_color_depth)} must be 16 numbers: write the "
                "4x4 matrix row by row."
            )

    def options(self) -> SequenceOptions:
        """Return the options with which a data set is opened.

        Raises:
            ConfigError: T_color_depth is no rigid transform.
        """
        if not self.T_color_depth:
            return SequenceOptions(register_depth=self.register_depth)
        T_color_depth = np.array(self.T_color_depth).reshape(4, 4)
        try:
            return SequenceOptions(register_depth=self.register_depth, T_color_depth=T_color_depth)
        except ConfigError as error:
            values = list(self.T_color_depth)
            raise ConfigError(f"dataset.T_color_depth={values} must be rigid: {error}") from error


@dataclass(frozen=True, slots=True)
class LatencySettings:
    """Latency of each actor on the logical clock of `ldo run`; the others answer at once."""

    # Boxes of a keyframe arrive so many frames later, on any machine.
    detector: NonNegativeInt = advanced(3)
    # A loop closure arrives so many frames later. Five places are examined at a time.
    loop_closer: NonNegativeInt = advanced(10)
    # A keyframe is in the map so many frames later.
    mapper: NonNegativeInt = advanced(3)
    # A correction arrives so many frames later.
    optimizer: NonNegativeInt = advanced(3)
    # A name arrives so many frames later, a second: the labeller is late by design.
    vlm_labeller: NonNegativeInt = advanced(30)


@dataclass(frozen=True, slots=True)
class OfflineSettings:
    """Runs over a file (`ldo run`)."""

    # A run fails when a larger fraction of the frames cannot be read.
    max_rejected_ratio: Ratio = 0.1
    latency_frames: LatencySettings = field(default_factory=LatencySettings)


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """Service (`ldo serve`)."""

    # These actors run in processes of their own. gtsam holds the GIL of its process.
    process_actors: tuple[str, ...] = ("optimizer",)
    # A soft stop waits so long for each stage to finish its work.
    shutdown_timeout_s: PositiveFloat = 10.0
    # A process without a heartbeat for so long is killed and started again.
    heartbeat_timeout_s: PositiveFloat = 10.0
    # Each step is on the disk before it is reported, at 12 ms a step. False may lose the state in a
    # power cut.
    fsync: bool = False
    # This folder holds the TLS keys that `ldo keys add` made. The option --keys names another.
    keys: str = ""
    # Larger messages are dropped by the network. A 4K frame has up to 58 MB.
    max_message_mb: Annotated[int, Meta(ge=1, le=1000)] = MAX_MESSAGE_MB
    # Prometheus metrics are served on this address. 0.0.0.0 shows everyone when the robot works.
    metrics_address: str = LOOPBACK
    # All actors obey `ldo control` within so long. The slowest measured took 0.6 s; a labeller may
    # wait for its server for 50 s.
    control_timeout_s: PositiveFloat = advanced(55.0)
    # Larger messages are not decoded. Raw color and depth of 8 megapixels have 58 MB.
    max_decoded_message_mb: PositiveFloat = advanced(64.0)


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Recordings (`ldo record`); 640x480 at 30 Hz makes 100 MB a second."""

    # A recording ends when its folder has this size.
    max_gb: PositiveFloat = 50.0
    # A recording ends when the disk has less space left, which the states of actors need.
    min_free_gb: NonNegativeFloat = 1.0


@dataclass(frozen=True, slots=True)
class SupervisionSettings:
    """Supervision of actors."""

    # An actor is given up when it fails more often within a minute. A restart does not cure that.
    max_restarts: NonNegativeInt = 5
    # An actor that stays in one step for so long is given up: 100 times the slowest step measured.
    step_timeout_s: PositiveFloat = 60.0
    # Threads whose work may be late get this niceness (Linux): a tenth of the weight of the
    # tracker.
    background_nice: Annotated[int, Meta(ge=0, le=19)] = 10
    # Each stage reports its health this often. A stopped process shows within two reports.
    heartbeat_s: PositiveFloat = advanced(0.5)
    # A consumer that takes nothing for so long is disconnected, because it holds up the robot.
    evict_after_s: PositiveFloat = advanced(30.0)


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Browser view (`ldo view`)."""

    # The window is served on this address. It needs no keys: whoever reaches it sees the map.
    address: str = LOOPBACK
    # The window is served on this port, or on the next free one. 0 takes any.
    port: Annotated[int, Meta(ge=0, le=65535)] = 8080
    # The browser shows so many Gaussians, the weightiest, at 32 bytes each.
    max_gaussians: PositiveInt = 300_000
    # The window looks for news this often: poses move at 5 Hz.
    update_interval_s: PositiveFloat = advanced(0.2)
