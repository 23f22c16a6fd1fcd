"""Settings of frame input, data sets, offline runs, service, recordings and viewer."""

import re
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta

from ldo_service.datasets import SequenceOptions
from ldo_service.errors import ConfigError
from ldo_service.kernels.gpu.device import Device
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
    """Pairing of color and depth images of a camera."""

    # Maximum difference of the stamps of a paired color and depth image, seconds. The
    # default is below half a frame period at 30 Hz, so that the nearest depth image is
    # paired.
    max_skew_s: Annotated[float, Meta(ge=0, lt=10)] = 0.015


@dataclass(frozen=True, slots=True)
class DatasetSettings:
    """Data sets: registration of depth (ScanNet, 7-Scenes, ROS bags), and topics of ROS bags."""

    # True registers depth to the color camera. False uses the depth as it is in the files.
    register_depth: bool = False
    # Transform from depth to color coordinates: the 16 numbers of the 4x4 matrix, row by row, with
    # the translation in meters. Empty uses the transform of the data set.
    T_color_depth: tuple[float, ...] = ()
    # Topics in a bag of ROS, such as `[color=/a/image_raw, depth=/b/image_raw, odometry=/odom]`. A
    # topic that is not listed is found by type and name.
    topics: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for topic in self.topics:
            if not re.fullmatch(r"(color|depth|odometry)=/\S+", topic):
                raise ConfigError(
                    f"dataset.topics={list(self.topics)} must be a list whose entries are "
                    "color=/TOPIC, depth=/TOPIC or odometry=/TOPIC."
                )
        if len(self.T_color_depth) not in (0, 16):
            raise ConfigError(
                f"dataset.T_color_depth={list(self.T_color_depth)} must be 16 numbers, the 4x4 "
                "matrix row by row."
            )

    def options(self) -> SequenceOptions:
        """Return the options for opening a data set.

        Raises:
            ConfigError: T_color_depth is not a rigid transform.
        """
        T_color_depth = np.array(self.T_color_depth).reshape(4, 4) if self.T_color_depth else None
        try:
            return SequenceOptions(
                register_depth=self.register_depth,
                T_color_depth=T_color_depth,
                topics=dict(topic.split("=", 1) for topic in self.topics),
            )
        except ConfigError as error:
            values = list(self.T_color_depth)
            raise ConfigError(
                f"dataset.T_color_depth={values} must be a rigid transform from depth to color "
                "coordinates in meters: a 4x4 matrix, row by row, whose last row is 0 0 0 1."
            ) from error


@dataclass(frozen=True, slots=True)
class LatencySettings:
    """Latency of actors on the logical clock of `ldo run`, in frames.

    Actors without a field here, such as the tracker, have a latency of 0 frames.
    """

    # Frames between a keyframe and its detections.
    detector: NonNegativeInt = advanced(3)
    # Frames between a keyframe and its loop closure, for the verification of five loop candidates.
    loop_closer: NonNegativeInt = advanced(10)
    # Frames between a keyframe and its addition to the map.
    mapper: NonNegativeInt = advanced(3)
    # Frames between a keyframe and a correction of the pose graph.
    optimizer: NonNegativeInt = advanced(3)
    # Frames between a label request and its result. The default is one second at 30 Hz, because a
    # labeller is slow.
    vlm_labeller: NonNegativeInt = advanced(30)


@dataclass(frozen=True, slots=True)
class OfflineSettings:
    """Offline runs over a sequence (`ldo run`)."""

    # Maximum fraction of frames that cannot be read. The run fails above this fraction.
    max_rejected_ratio: Ratio = 0.1
    # Simulated latency of the actors other than the tracker.
    latency_frames: LatencySettings = field(default_factory=LatencySettings)


@dataclass(frozen=True, slots=True)
class ServiceSettings:
    """Live service (`ldo serve`), and the device for mapping, tracking and networks."""

    # Device of the mapper's optimizer, of the tracker's alignment and of the networks. cuda uses a
    # GPU that passes a self-test. With auto, `ldo bench --device cuda` must also have measured the
    # GPU to be faster for mapper or tracker. Both are experimental on a GPU until then. openvino
    # applies to the networks alone.
    device: Device = "cpu"
    # Actors that run in processes of their own. The default is the actor that uses gtsam, which
    # holds the GIL during every call.
    process_actors: tuple[str, ...] = ("optimizer",)
    # Actors that run on another machine, by `ldo serve --client --actor NAME`. This service
    # does not wait for them.
    remote_actors: tuple[Literal["detector", "vlm_labeller", "loop_closer", "optimizer"], ...] = ()
    # Maximum time for each actor to handle its queued messages when the service stops, seconds. All
    # actors together have at most 2.2 times as long.
    shutdown_timeout_s: PositiveFloat = 10.0
    # Seconds without a heartbeat after which a process is killed and started again.
    heartbeat_timeout_s: PositiveFloat = 10.0
    # True calls fsync after each step, before the outputs of the step are published. This takes 12
    # ms per step. With False, a power cut loses the keyframes of the last one or two seconds.
    fsync: bool = False
    # Folder with the TLS keys that `ldo keys add` made. The option --keys overrides it.
    keys: str = ""
    # Maximum size of a message, MB. The network drops larger messages. A 4K frame has up to 58 MB.
    max_message_mb: Annotated[int, Meta(ge=1, le=1000)] = MAX_MESSAGE_MB
    # Address on which Prometheus metrics are served. With 0.0.0.0 anyone on the network can
    # see when the robot works.
    metrics_address: str = LOOPBACK
    # Maximum time for all actors to execute `ldo control`, seconds. The slowest measured command
    # took 0.6 s, but a labeller may wait 50 s for its server.
    control_timeout_s: PositiveFloat = advanced(55.0)
    # Maximum size of a message that is decoded, MB. Raw color and depth of 8 megapixels have 58 MB.
    max_decoded_message_mb: PositiveFloat = advanced(64.0)


@dataclass(frozen=True, slots=True)
class RecordingSettings:
    """Recordings (`ldo record`); 640x480 pixels at 30 Hz take 100 MB per second."""

    # Maximum size of the folder of a recording in GB, at which the recording ends.
    max_gb: PositiveFloat = 50.0
    # Minimum free disk space in GB, which the states of actors need. The recording ends when less
    # space is free.
    min_free_gb: NonNegativeFloat = 1.0


@dataclass(frozen=True, slots=True)
class SupervisionSettings:
    """Supervision of actors."""

    # Maximum number of restarts of an actor within a minute. A further failure ends the service,
    # because restarts do not help then.
    max_restarts: NonNegativeInt = 5
    # Maximum duration of one step of an actor, seconds. The default is 100 times the slowest step
    # measured.
    step_timeout_s: PositiveFloat = 60.0
    # Maximum duration of one step of the optimizer, loop closer, detector or labeller, seconds. No
    # other actor waits for these four. One optimization of a large pose graph may take minutes.
    backend_step_timeout_s: PositiveFloat = advanced(600.0)
    # Maximum disk space for queued messages, MB, on each topic that the optimizer, loop closer,
    # detector or labeller receives. Beyond this size, the oldest messages are dropped. The default
    # holds 11 minutes of keyframes of 640x480 at 2 Hz.
    backlog_mb: PositiveFloat = 2000.0
    # Niceness of threads that may run late (Linux). The default gives them a tenth of the CPU
    # weight of the tracker.
    background_nice: Annotated[int, Meta(ge=0, le=19)] = 10
    # Interval of heartbeats, seconds. A missing heartbeat is noticed within two intervals.
    heartbeat_s: PositiveFloat = advanced(0.5)
    # Time without handling a message after which a consumer with a full queue is evicted, seconds.
    # Such a consumer blocks its producers.
    evict_after_s: PositiveFloat = advanced(30.0)


@dataclass(frozen=True, slots=True)
class ViewerSettings:
    """Browser view (`ldo view`)."""

    # Address on which the window is served. The window needs no keys, so anyone who can reach this
    # address can see the map.
    address: str = LOOPBACK
    # Port on which the window is served. If it is in use, the next free port is taken. 0 uses any
    # free port.
    port: Annotated[int, Meta(ge=0, le=65535)] = 8080
    # Maximum number of Gaussians in the browser, at 32 bytes each. Those that cover
    # the most area with the highest opacity are sent.
    max_gaussians: PositiveInt = 300_000
    # Interval of updates of the window, seconds. The default shows poses at 5 Hz.
    update_interval_s: PositiveFloat = advanced(0.2)
