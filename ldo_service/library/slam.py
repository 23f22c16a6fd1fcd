"""SLAM in this process: frames in, poses and a map out.

    from ldo_service import Camera, Slam

    with Slam(Camera(width=640, height=480, fx=525, fy=525, cx=320, cy=240)) as slam:
        for color, depth_m, stamp_ns in frames:
            pose = slam.track(color, depth_m, stamp_ns)
        slam.finish()
        slam.save("runs/desk")

The actors are those of `ldo run`, on the same logical clock. Equal frames and settings therefore
give the same poses and the same map, bit for bit.
"""

import signal
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from operator import index
from os import PathLike
from pathlib import Path
from types import FrameType
from typing import Any, Literal

import msgspec
import numpy as np

from ldo_service.config import Config, load_config
from ldo_service.conversions.frames import camera_from_message, raw_frame_to_message
from ldo_service.conversions.poses import pose_from_message
from ldo_service.errors import ConfigError, FrameError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.maps.object_search import ObjectMatch
from ldo_service.runs.actor_run import ActorRun, refinements
from ldo_service.runs.folder import prepare
from ldo_service.schemas import Keyframe, Message, RefineMap, TrackedPose

from .maps import Map, find

FrameArray = Any  # An array that supports DLPack or the buffer protocol.
FilePath = str | PathLike[str]


@dataclass(frozen=True, eq=False, slots=True)
class Pose:
    """Pose of the camera at a frame. Arrays are float64 and read-only."""

    frame: int  # Number of the frame, from 0.
    stamp_ns: int
    status: Literal["OK", "WEAK", "LOST"]
    # [4, 4], camera to map. It includes the corrections so far. None while LOST, and in a submap
    # that is not merged with the map yet.
    T_map_camera: np.ndarray | None
    # [4, 4], camera to odometry. It is continuous while the status is not LOST; while LOST, it is
    # the last pose.
    T_odom_camera: np.ndarray
    # [6, 6] covariance of the pose relative to its reference keyframe, for a perturbation on the
    # right: rotation in rad, then translation in m. Zeros if unknown.
    covariance: np.ndarray
    keyframe: int | None  # Id of the keyframe that was made of the frame; None if none was made.
    submap: int  # 0 is the map itself.


class Slam:
    """Tracking and mapping of the frames of one camera in this process.

    Use it as a context manager, or call `close`. After `close`, the map, the trajectory and the
    objects stay available. Several objects may exist side by side, but one object must not be used
    by two threads at a time. An interrupt by Ctrl-C takes effect after the current frame, so the
    object can be used further.
    """

    def __init__(
        self,
        camera: Camera,
        *,
        depth_scale: float = 1.0,
        config: Config | FilePath | None = None,
        settings: Mapping[str, object] | None = None,
    ) -> None:
        """Create the actors.

        Args:
            camera: Intrinsics of the images, with lens distortion if there is any.
            depth_scale: Units of the depth images per meter: 1 for meters, 1000 for millimeters.
            config: Configuration, or path of a YAML file with settings; None for the defaults.
            settings: Settings by dotted name, such as `{"mapper.iterations": 7}`, on top of a file
                or the defaults.

        Raises:
            ConfigError: A setting or the type of an argument is wrong.
        """
        if not isinstance(camera, Camera):
            raise ConfigError(
                f"camera is a {type(camera).__name__}, must be an ldo_service.Camera, such as "
                "Camera(width=640, height=480, fx=525, fy=525, cx=320, cy=240)."
            )
        self.camera, self.depth_scale = camera, depth_scale
        self.config = _configured(config, settings or {})
        self._run = ActorRun(self.config, None, observe=self._observe)
        self._frames = self._rejected = 0
        self._last_stamp_ns = -1
        self._last_pose: TrackedPose | None = None
        self._map_camera: Camera | None = None
        self._remaining: Iterator[RefineMap | None] | None = None  # Work that `finish` has begun.
        self._is_finished = self._is_closed = False

    def __enter__(self) -> "Slam":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Slam with {self._frames} frames and {self._run.record.keyframes} keyframes"

    # --- frames -----------------------------------------------------------------------------------
    def track(self, color: FrameArray, depth: FrameArray, stamp_ns: int) -> Pose:
        """Track a frame, and map it if it becomes a keyframe.

        The arrays may be of NumPy, of another library with DLPack such as torch on the CPU, or
        buffers. They are copied, so the caller may reuse them.

        Args:
            color: RGB image, [H, W, 3] uint8.
            depth: Depth z registered to the color image, [H, W] float32, float64 or uint16 in
                1/depth_scale meters; 0, NaN or infinity where not measured.
            stamp_ns: Time of the exposure in ns, later than that of the last frame.

        Returns:
            The pose of the frame.

        Raises:
            FrameError: An argument has a wrong type, shape or stamp. The frame is skipped, and
                tracking continues with the next one.
            ConfigError: `finish` or `close` was called before.
        """
        self._require_open("track")
        if self._is_finished or self._remaining is not None:
            raise ConfigError("track was called after finish. Create another Slam for more frames.")
        number, self._frames = self._frames, self._frames + 1
        try:
            frame = self._raw_frame(number, color, depth, stamp_ns)
        except FrameError:
            self._rejected += 1
            raise
        message = raw_frame_to_message(frame, compress_depth=False)
        with _interrupts_delayed():
            self._last_stamp_ns = frame.stamp_ns
            self._run.tick(message)
        pose = self._last_pose
        if pose is None or pose.frame != number:
            raise FrameError(
                f"frame {number} was rejected. The log of ldo_service has the reason; "
                "logging.basicConfig() shows it."
            )
        return _pose(pose)

    def finish(self, refine_iterations: int = 0) -> None:
        """Wait for the mapping of all frames, close the last loops, and refit the moved keyframes.

        After an interrupt, another call continues.

        Args:
            refine_iterations: Iterations that optimize the whole map further.

        Raises:
            ConfigError: `close` was called before, or the number is negative.
        """
        self._require_open("finish")
        if refine_iterations < 0:
            raise ConfigError(f"refine_iterations={refine_iterations} must not be negative.")
        if self._is_finished and not refine_iterations:
            return
        if self._remaining is None:
            due = 0
            if not self._is_finished:
                with _interrupts_delayed():
                    self._run.end_stream()
                due = self._run.pending_iterations
            self._remaining = self._requests(due, refine_iterations)
        while self._remaining is not None:
            with _interrupts_delayed():
                self._refine_further(self._remaining)

    def close(self) -> None:
        """End the threads of the actors. Frames that are not mapped yet are dropped."""
        if not self._is_closed:
            self._is_closed = True
            self._run.__exit__(None, None, None)

    # --- results ----------------------------------------------------------------------------------
    @property
    def map(self) -> Map:
        """The map so far, a copy; it lacks the Gaussians of submaps that are not merged."""
        record = self._run.record
        in_map, replica = record.in_map(), record.replica
        labels = replica.map.labels[in_map] if replica.label_names else None
        return Map(replica.map.rows[in_map], labels, replica.label_names, self._map_camera)

    def trajectory(self) -> Trajectory:
        """Return T_map_camera of all frames that are not LOST, after all corrections so far.

        Frames of submaps that are not merged with the map are omitted.
        """
        return self._run.record.final()

    def objects(self, text: str | None = None) -> list[ObjectMatch]:
        """Return the objects of the map, which need a detector (`detector.model`).

        Args:
            text: Name or synonym; None for all objects.

        Returns:
            The objects that match, best match first; empty if there are none.
        """
        return find(self._run.record.placed_objects(), text, self.trajectory().T_world_camera)

    def save(self, folder: FilePath, *, overwrite: bool = False) -> Path:
        """Write the folder of a run, as `ldo run` does: docs/run-folder.md.

        Args:
            folder: The folder; it is created.
            overwrite: True replaces the files of an earlier run.

        Returns:
            The folder. `Run.open` reads it, and so do `ldo eval`, `ldo view` and `ldo export`.

        Raises:
            ConfigError: The folder is not empty, or cannot be written.
        """
        path = Path(folder).expanduser()
        prepare(path, overwrite)
        summary = self._run.summary(self._frames, self._rejected, is_finished=self._is_finished)
        try:
            self._run.record.save(path, summary)
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be written: {error.strerror}. Free some space, or choose another "
                "folder; the files in this one are incomplete."
            ) from error
        return path

    # --- internals --------------------------------------------------------------------------------
    def _raw_frame(
        self, number: int, color: FrameArray, depth: FrameArray, stamp_ns: int
    ) -> RawFrame:
        images = _array("color", color), _array("depth", depth)
        if images[1].dtype == np.uint16 and self.depth_scale == 1.0:
            raise FrameError(
                "depth is uint16, but depth_scale is 1, so a unit would be a meter. Create "
                "Slam(camera, depth_scale=1000) for millimeters, or give meters as float32."
            )
        try:
            stamp = index(stamp_ns)
        except TypeError as error:
            raise FrameError(
                f"stamp_ns={stamp_ns!r} must be an integer number of nanoseconds, such as "
                "round(1e9 * seconds)."
            ) from error
        if stamp <= self._last_stamp_ns:
            raise FrameError(
                f"stamp_ns={stamp} must be later than the stamp of the last frame, "
                f"{self._last_stamp_ns}, and not negative."
            )
        return RawFrame(number, stamp, *images, self.depth_scale, self.camera)

    def _requests(self, due: int, refine: int) -> Iterator[RefineMap | None]:
        """Yield the requests of each refinement, and None after its last one."""
        stamp_ns = self._run.record.newest_stamp_ns
        for iterations in (due, refine):
            if iterations:
                yield from refinements(iterations, stamp_ns)
                yield None

    def _refine_further(self, remaining: Iterator[RefineMap | None]) -> None:
        try:
            request = next(remaining)
        except StopIteration:
            self._remaining, self._is_finished = None, True
            return
        if request is None:
            self._run.finish()
        else:
            self._run.tick(request)

    def _observe(self, message: Message, _tick: int) -> None:
        if isinstance(message, TrackedPose):
            self._last_pose = message
        elif isinstance(message, Keyframe) and self._map_camera is None:
            self._map_camera = camera_from_message(message.camera).rectified()

    def _require_open(self, call: str) -> None:
        if self._is_closed:
            raise ConfigError(f"{call} was called after close. Create another Slam.")


def _configured(config: Config | FilePath | None, settings: Mapping[str, object]) -> Config:
    if isinstance(config, Config):
        if settings:
            raise ConfigError("config is a Config already; put the settings into it.")
        return config
    given = [f"{name}={_plain(value)}" for name, value in settings.items()]
    return load_config(None if config is None else Path(config).expanduser(), given)


def _plain(value: object) -> str:
    """Return a value as YAML: text stays as it is, all else is JSON, which YAML contains."""
    return value if isinstance(value, str) else msgspec.json.encode(value).decode()


def _array(name: str, value: FrameArray) -> np.ndarray:
    """Return an array of a user as NumPy array, without a copy where possible.

    Raises:
        FrameError: The value is no array, or lies in the memory of a GPU.
    """
    try:
        if isinstance(value, np.ndarray):
            return value
        if hasattr(value, "__dlpack__"):
            return np.from_dlpack(value)
        if not isinstance(value, (list, tuple)):
            array = np.asarray(value)
            if array.ndim:
                return array
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise FrameError(
            f"{name} is a {type(value).__name__} that cannot be read as an array: {error}. Give a "
            "NumPy array, or a tensor on the CPU without gradient."
        ) from error
    raise FrameError(
        f"{name} is a {type(value).__name__}, must be an array, such as numpy.ndarray or a tensor "
        "on the CPU."
    )


def _pose(message: TrackedPose) -> Pose:
    T_odom_camera = pose_from_message(message.T_odom_camera)
    T_map_camera = None
    if message.status != "LOST" and message.submap == 0:
        T_map_camera = pose_from_message(message.T_map_odom) @ T_odom_camera
        T_map_camera.flags.writeable = False
    T_odom_camera.flags.writeable = False
    covariance = np.array(message.covariance).reshape(6, 6)
    covariance.flags.writeable = False
    return Pose(
        message.frame,
        message.stamp_ns,
        message.status,
        T_map_camera,
        T_odom_camera,
        covariance,
        message.keyframe,
        message.submap,
    )


@contextmanager
def _interrupts_delayed() -> Iterator[None]:
    """Handle Ctrl-C after the block instead of within it, so that each step is complete.

    Only the main thread receives the interrupt, so the block does nothing in other threads.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = signal.getsignal(signal.SIGINT)
    if not callable(before):  # Ctrl-C is ignored, or handled outside of Python.
        yield
        return
    pressed: list[FrameType | None] = []
    signal.signal(signal.SIGINT, lambda _number, frame: pressed.append(frame))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)
    if pressed:
        before(signal.SIGINT, pressed[0])
