"""SLAM in this process: its inputs are frames, its results are poses and a map.

    from ldo_service import Camera, Slam

    with Slam(Camera(width=640, height=480, fx=525, fy=525, cx=320, cy=240)) as slam:
        for color, depth_m, stamp_ns in frames:
            pose = slam.track(color, depth_m, stamp_ns)
        slam.finish()
        slam.save("runs/desk")

`Slam` runs the same actors as `ldo run`, on a logical clock that ticks once per frame. Equal frames
and settings therefore give the same poses and the same map, bit for bit.
"""

from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from operator import index
from os import PathLike
from pathlib import Path

import numpy as np

from ldo_service.config import Config, load_config
from ldo_service.conversions.frames import camera_from_message, raw_frame_to_message
from ldo_service.conversions.poses import pose_to_message
from ldo_service.errors import ConfigError, FrameError, StageError
from ldo_service.geometry import Camera, RawFrame, Trajectory, se3
from ldo_service.runs.actor_run import ActorRun, refinements
from ldo_service.runs.folder import prepare
from ldo_service.runs.networks import require_usable_networks
from ldo_service.runs.source import T_base_camera
from ldo_service.runs.summary import Usage
from ldo_service.schemas import Keyframe, Message, OdometryPrior, TrackedPose
from ldo_service.schemas.message import LAST_INTEGER

from .arrays import FrameArray, array_of, read_only, rigid_transform
from .interrupts import interrupts_delayed
from .maps import FoundObject, Map, find
from .pose import Pose, pose_of

FilePath = str | PathLike[str]
DONE = object()  # Result of `next` for an iterator without further items.


class Slam:
    """Tracking and mapping of the frames of one camera in this process.

    Use it as a context manager, or call `close`. After `close`, the map, the trajectory and the
    detected objects stay available. Several instances may exist at the same time, but two threads
    must not use one instance at the same time. Ctrl-C takes effect after the current frame, so the
    instance can be used further unless a `with` block has closed it. A second Ctrl-C takes effect
    immediately; the instance can then track no more frames.

    Attributes:
        camera: Camera of the frames.
        depth_scale: Number of depth units per meter.
        config: Configuration in use.
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
                or the defaults. The key `preset` selects a preset, which the file then changes.

        Raises:
            ConfigError: A setting or the type of an argument is wrong, or a network that the
                settings name cannot be used.
        """
        if not isinstance(camera, Camera):
            raise ConfigError(
                f"camera is a {type(camera).__name__}, must be an ldo_service.Camera, such as "
                "Camera(width=640, height=480, fx=525, fy=525, cx=320, cy=240)."
            )
        is_number = isinstance(depth_scale, (int, float, np.number))
        if not (is_number and np.isfinite(depth_scale) and depth_scale > 0):
            raise ConfigError(
                f"depth_scale={depth_scale!r} must be the positive number of depth units per "
                "meter, such as 1000 for millimeters."
            )
        self.camera, self.depth_scale = camera, float(depth_scale)
        self.config = _configured(config, settings)
        require_usable_networks(self.config)
        self._T_camera_base = se3.inverse(T_base_camera(self.config))
        self._run = ActorRun(self.config, None, observe=self._observe)
        self._frames = self._rejected = self._refined = 0
        self._used = Usage(0.0, 0.0)  # Time of all steps.
        self._last_stamp_ns = -1
        self._last_pose: TrackedPose | None = None
        self._map_camera: Camera | None = None
        # Unfinished work of `finish`. Each `next` of an iterator does one step.
        self._steps: deque[Iterator[None]] = deque()
        self._is_ending = self._is_closed = False
        self._failure: str | None = None  # Failure after which no step is possible.

    def __enter__(self) -> "Slam":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"Slam with {self._frames} frames and {self._run.record.keyframes} keyframes"

    # --- frames -----------------------------------------------------------------------------------
    def track(
        self,
        color: FrameArray,
        depth: FrameArray,
        stamp_ns: int,
        prior: FrameArray | None = None,
    ) -> Pose:
        """Track a frame, and map it if it becomes a keyframe.

        Images may be NumPy arrays, arrays of another library with DLPack such as torch on the CPU,
        or buffers. They are copied, so the caller may reuse them.

        Args:
            color: RGB image, [H, W, 3] uint8.
            depth: Depth z registered to the color image, [H, W] float32, float64 or uint16. Its
                unit is 1/depth_scale meters; it is 0, NaN or infinity where not measured.
            stamp_ns: Time of the exposure in ns, later than that of the last frame.
            prior: T_odom_camera [4, 4] of another odometry at the time of the exposure, such as
                that of a phone; None if unknown. Only the motion between two priors is used, as an
                initial guess.

        Returns:
            The pose of the frame.

        Raises:
            FrameError: An argument has a wrong type, shape or stamp. The frame is skipped, and
                tracking continues with the next one.
            StageError: An actor failed in this or an earlier call. The results so far stay usable.
            ConfigError: `finish` or `close` was called before.
        """
        self._require_usable("track")
        if self._is_ending:
            raise ConfigError("track was called after finish. Create another Slam for more frames.")
        with interrupts_delayed():
            number, self._frames = self._frames, self._frames + 1
            try:
                frame = self._raw_frame(number, color, depth, stamp_ns)
                pose_before = None if prior is None else self._prior(prior, frame.stamp_ns)
            except FrameError:
                self._rejected += 1
                raise
            self._last_stamp_ns = frame.stamp_ns
            with self._step():
                message = raw_frame_to_message(frame, compress_depth=False)
                self._run.tick(message if pose_before is None else (pose_before, message))
        pose = self._last_pose
        if pose is None or pose.frame != number:
            raise FrameError(
                f"frame {number} was rejected. The log of ldo_service has the reason. Call "
                "logging.basicConfig() before `track` to show the log."
            )
        return pose_of(pose)

    def finish(self, refine_iterations: int = 0) -> None:
        """Wait for the mapping of all frames, close the last loops, and refit the moved keyframes.

        If Ctrl-C interrupts the call, another call continues the work. Each further call with
        `refine_iterations` above 0 refines the map further.

        Args:
            refine_iterations: Number of additional iterations that optimize the whole map.

        Raises:
            ConfigError: `close` was called before, or `refine_iterations` is negative.
            StageError: An actor failed in this or an earlier call. The results so far stay usable.
        """
        self._require_usable("finish")
        if not isinstance(refine_iterations, int) or refine_iterations < 0:
            raise ConfigError(
                f"refine_iterations={refine_iterations!r} must be an integer of at least 0."
            )
        if not self._is_ending:
            self._is_ending = True
            self._steps.append(self._end())
        if refine_iterations:
            self._refined += refine_iterations
            self._steps.append(self._refine(refine_iterations))
        while self._steps:
            with interrupts_delayed(), self._step():
                if next(self._steps[0], DONE) is DONE:
                    self._steps.popleft()

    def close(self) -> None:
        """End the threads of the actors. Frames that are not mapped yet are dropped."""
        if not self._is_closed:
            with interrupts_delayed():
                self._run.__exit__(None, None, None)
            self._is_closed = True

    # --- results ----------------------------------------------------------------------------------
    @property
    def map(self) -> Map:
        """Copy of the map so far, without the Gaussians of submaps that are not merged yet."""
        record = self._run.record
        in_map, replica = record.in_map(), record.replica
        labels = replica.map.labels[in_map] if replica.label_names else None
        return Map(replica.map.rows[in_map], labels, replica.label_names, self._map_camera)

    def trajectory(self) -> Trajectory:
        """Return T_map_camera of all frames that are not LOST, after all corrections so far.

        Frames of submaps that are not merged with the map are omitted.
        """
        return read_only(self._run.record.final())

    def objects(self, text: str | None = None) -> list[FoundObject]:
        """Return the objects of the map. Without a detector (`detector.model`), there are none.

        Args:
            text: Name or synonym of the objects; None for all objects.

        Returns:
            The objects that match, best match first; empty if there are none.
        """
        return find(self._run.record.placed_objects(), text, self.trajectory().T_world_camera)

    def save(self, folder: FilePath, *, overwrite: bool = False) -> Path:
        """Write the folder of a run, as `ldo run` does; see docs/run-folder.md.

        The folder contains the map after all iterations of `finish`. The times and the frame rate
        in summary.json cover only the work of this object, not the time between its calls.

        Args:
            folder: The folder; it is created.
            overwrite: True replaces the files of an earlier run in this folder.

        Returns:
            The folder. `Run.open` reads it, and so do `ldo eval`, `ldo view` and `ldo export`.

        Raises:
            ConfigError: The folder cannot be written, or it has files and `overwrite` is False.
        """
        path = Path(folder).expanduser()
        is_finished = self._is_ending and not self._steps and self._failure is None
        try:
            with interrupts_delayed():
                prepare(path, overwrite)
                summary = self._run.summary(
                    self._frames, self._rejected, self._used, is_finished=is_finished
                )
                if self._refined:
                    summary["refine_iterations"] = self._refined
                self._run.record.save(path, summary)
        except OSError as error:
            raise ConfigError(
                f"{path} cannot be written: {error.strerror}. The files in this folder are "
                "incomplete. Free some space, or choose another folder."
            ) from error
        return path

    # --- internals --------------------------------------------------------------------------------
    def _raw_frame(
        self, number: int, color: FrameArray, depth: FrameArray, stamp_ns: int
    ) -> RawFrame:
        images = array_of("color", color), array_of("depth", depth)
        if images[1].dtype == np.uint16 and self.depth_scale == 1.0:
            raise FrameError(
                "depth is uint16, but depth_scale=1 means that one unit is a meter. Create "
                "Slam(camera, depth_scale=1000) for millimeters, or give meters as float32."
            )
        try:
            stamp = index(stamp_ns)
        except TypeError as error:
            raise FrameError(
                f"stamp_ns={stamp_ns!r} must be an integer number of nanoseconds, such as "
                "round(1e9 * seconds)."
            ) from error
        if not 0 <= stamp <= LAST_INTEGER:
            raise FrameError(
                f"stamp_ns={stamp} must be a number of nanoseconds from 0 to {LAST_INTEGER}."
            )
        if stamp <= self._last_stamp_ns:
            raise FrameError(
                f"stamp_ns={stamp} must be later than the stamp of the last frame, "
                f"{self._last_stamp_ns}."
            )
        return RawFrame(number, stamp, *images, self.depth_scale, self.camera)

    def _prior(self, value: FrameArray, stamp_ns: int) -> OdometryPrior:
        """Return the message of a pose T_odom_camera of another odometry.

        Raises:
            FrameError: The value is no rigid transform.
        """
        T_odom_camera = rigid_transform("prior", array_of("prior", value), FrameError)
        T_odom_base = T_odom_camera @ self._T_camera_base
        return OdometryPrior(stamp_ns=stamp_ns, T_prior_base=pose_to_message(T_odom_base))

    def _end(self) -> Iterator[None]:
        """Do the work of `finish`, one step per item: end the stream, then refit the map."""
        self._run.end_stream()
        yield
        if due := self._run.pending_iterations:
            yield from self._refine(due)

    def _refine(self, iterations: int) -> Iterator[None]:
        """Refine the map, one step per item."""
        for request in refinements(iterations, self._run.record.newest_stamp_ns):
            self._run.tick(request)
            yield
        self._run.finish()
        yield

    @contextmanager
    def _step(self) -> Iterator[None]:
        """Add up the time of a step, and note a failure or a second Ctrl-C within it."""
        started = Usage.now()
        try:
            yield
        except StageError as error:
            self._failure = str(error)
            raise
        except BaseException as error:
            self._failure = f"{type(error).__name__} interrupted a step of the actors."
            raise
        finally:
            self._used = self._used.plus(Usage.now().since(started))

    def _observe(self, message: Message, _tick: int) -> None:
        if isinstance(message, TrackedPose):
            self._last_pose = message
        elif isinstance(message, Keyframe) and self._map_camera is None:
            self._map_camera = camera_from_message(message.camera).rectified()

    def _require_usable(self, call: str) -> None:
        if self._is_closed:
            raise ConfigError(f"{call} was called after close. Create another Slam.")
        if self._failure is not None:
            raise StageError(
                f"{call} is not possible after a failure: {self._failure} The results so far can "
                "be saved. Create another Slam for more frames."
            )


def _configured(config: Config | FilePath | None, settings: Mapping[str, object] | None) -> Config:
    if settings is not None and not isinstance(settings, Mapping):
        raise ConfigError(
            f"settings is a {type(settings).__name__}, must be a mapping such as "
            '{"mapper.iterations": 7}.'
        )
    if isinstance(config, Config):
        if settings:
            raise ConfigError(
                "settings cannot be combined with a Config. Put the settings into this Config."
            )
        return config
    if config is not None and not isinstance(config, (str, PathLike)):
        raise ConfigError(
            f"config is a {type(config).__name__}, must be a Config or the path of a YAML file. "
            "Give single settings as settings={...}."
        )
    return load_config(None if config is None else Path(config).expanduser(), values=settings)
