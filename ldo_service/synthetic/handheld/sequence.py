"""Sequences of a simulated hand-held camera with the effects of real cameras and ground truth."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Protocol

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import FrameLabels, Sequence, TrueLabels
from ldo_service.synthetic.flat.cache import CachedFrame, FrameCache
from ldo_service.synthetic.flat.render import FlatRenderer
from ldo_service.synthetic.flat.scene import furnished_flat
from ldo_service.synthetic.flat.scene_object import CLASS_NAMES
from ldo_service.synthetic.path import LOOK_AROUND, TOUR
from ldo_service.synthetic.person import person_at
from ldo_service.synthetic.room import furnished_room
from ldo_service.synthetic.room_render import Renderer

from .color_sensor import (
    MEMORY_FRAMES,
    RowPoses,
    automatic_gains,
    blurred,
    recorded,
    vignetting,
)
from .depth_sensors import DepthBias, measure
from .effects import Effects, parse_effects
from .motion import HandMotion, flat_motion, room_motion

VERSION = 2  # Part of the cache's identity; increase it if a change alters a byte of any frame.
MARK = "-handheld"
WIDTH_PX, HEIGHT_PX = 640, 480
FOCAL_PX = 520.0  # Horizontal field of view of 63 degrees, as in a Kinect's color camera.
# k1, k2, p1, p2, k3 of the Kinect of the TUM RGB-D sequences freiburg1.
DISTORTION = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
READOUT_S = 0.025  # Rolling shutter: time between the first row and the last row.
EXPOSURE_S = 0.02
# Bounds of the delay of depth after color; the seed determines the delay.
MIN_DELAY_S, MAX_DELAY_S = 0.010, 0.020
METERING_STEP = 16  # Automatic exposure measures an image whose sides are smaller by this factor.


@dataclass(frozen=True, slots=True)
class ExactImages:
    """Images that a perfect camera would record."""

    light: np.ndarray  # [H, W, 3] float64 in 0..1.
    depth_m: np.ndarray  # [H, W] float64.
    class_ids: np.ndarray  # [H, W] uint8; 0 in scenes without labels.
    instance_ids: np.ndarray  # [H, W] uint16; 0 for the building and in scenes without labels.


class Scene(Protocol):
    """Scene that a camera image can be rendered from."""

    def render(self, camera: Camera, T_world_camera: np.ndarray, time_s: float) -> ExactImages:
        """Render the scene.

        Args:
            camera: Intrinsics.
            T_world_camera: Camera pose [4, 4], or one pose for each image row, [H, 4, 4].
            time_s: Time since the first frame; it determines the positions of moving objects.
        """
        ...


class RoomScene:
    """Furnished room, optionally with a person who walks through it."""

    def __init__(self, seed: int, *, has_person: bool = False) -> None:
        self._renderer, self._has_person = Renderer(furnished_room(seed)), has_person

    def render(self, camera: Camera, T_world_camera: np.ndarray, time_s: float) -> ExactImages:
        """Render the room; see `Scene.render`."""
        visitors = person_at(time_s) if self._has_person else ()
        seen = self._renderer.render(camera, T_world_camera, visitors)
        nothing = np.zeros(seen.depth_m.shape)
        return ExactImages(
            seen.light, seen.depth_m, nothing.astype(np.uint8), nothing.astype(np.uint16)
        )


class FlatScene:
    """Furnished flat with labels."""

    def __init__(self, seed: int) -> None:
        self._renderer = FlatRenderer(furnished_flat(seed))

    def render(
        self,
        camera: Camera,
        T_world_camera: np.ndarray,
        time_s: float,  # noqa: ARG002
    ) -> ExactImages:
        """Render the furnished flat, which is the same at all times; see `Scene.render`."""
        seen = self._renderer.render(camera, T_world_camera)
        return ExactImages(seen.light, seen.depth_m, seen.class_ids, seen.instance_ids)


@dataclass(frozen=True, slots=True)
class Walk:
    """Scene with the motion of the camera through it."""

    scene: Callable[[int], Scene]  # Function of the seed that creates the scene.
    motion: Callable[[int], HandMotion]  # Function of the seed that creates the motion.
    frames: int
    rate_hz: int


WALKS = {
    "room": Walk(RoomScene, lambda seed: room_motion(LOOK_AROUND, 4.4, seed), 132, 30),
    "tour": Walk(RoomScene, lambda seed: room_motion(TOUR, 8.0, seed), 240, 30),
    "person": Walk(
        lambda seed: RoomScene(seed, has_person=True),
        lambda seed: room_motion(LOOK_AROUND, 4.4, seed),
        132,
        30,
    ),
    "flat": Walk(FlatScene, lambda seed: flat_motion(33.0, seed), 495, 15),
}
NAMED = tuple(f"{name}{MARK}" for name in WALKS)


@dataclass(frozen=True, slots=True)
class HandheldConfig:
    """Parameters of a simulated sequence; equal parameters give bitwise equal images."""

    walk: str = "room"  # Scene and motion, a key of WALKS.
    effects: Effects = field(default_factory=Effects)  # Effects of real cameras to simulate.
    seed: int = 0  # Seed of textures, hand shake, delay, bias and noise.

    def __post_init__(self) -> None:
        if self.walk not in WALKS:
            raise ConfigError(
                f"simulated camera: walk={self.walk!r} must be one of {', '.join(WALKS)}."
            )
        if self.seed < 0:
            raise ConfigError(f"simulated camera: seed={self.seed} must be at least 0.")


class HandheldSequence(Sequence):
    """Walk with a simulated camera; each frame is rendered once and cached on disk.

    The stamp of a frame is the time at which the middle row of the color image is exposed, and the
    true pose is the pose at that time.
    """

    def __init__(self, config: HandheldConfig, name: str = "handheld") -> None:
        self.config, self._walk = config, WALKS[config.walk]
        distortion = DISTORTION if config.effects.distortion else ()
        center_px = ((WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2)
        camera = Camera(WIDTH_PX, HEIGHT_PX, FOCAL_PX, FOCAL_PX, *center_px, distortion)
        frames = np.arange(self._walk.frames, dtype=np.int64)
        super().__init__(name, camera, frames * 10**9 // self._walk.rate_hz)
        self._motion = self._walk.motion(config.seed)
        self._cache = FrameCache(f"handheld {VERSION} {config}", WIDTH_PX, HEIGHT_PX)
        delay = float(np.random.default_rng([config.seed, 10]).random())
        has_delay = config.effects.late_depth
        self.depth_delay_s = MIN_DELAY_S + delay * (MAX_DELAY_S - MIN_DELAY_S) if has_delay else 0.0
        self._metered = lru_cache(maxsize=2 * MEMORY_FRAMES)(self._mean_light)

    @staticmethod
    def named(name: str, **changes: int | bool) -> "HandheldSequence":
        """Return the sequence `synthetic:NAME`, with the config fields in `changes` replaced.

        Args:
            name: Name with optional effects, such as `tour-handheld:blur+kinect`.
            **changes: Values of fields of the config, such as `seed`.

        Raises:
            DataError: If the scene or an effect is unknown.
        """
        scene, _, effects = name.partition(MARK)
        if scene not in WALKS or (effects and not effects.startswith(":")):
            known = ", ".join(f"synthetic:{known}" for known in NAMED)
            raise DataError(f"unknown sequence synthetic:{name}. Choose one of {known}.")
        config = replace(HandheldConfig(scene, parse_effects(effects, name)), **changes)
        seed = f"@{config.seed}" if config.seed else ""
        return HandheldSequence(config, f"synthetic:{name}{seed}")

    # --- truth --------------------------------------------------------------------------------
    def truth(self) -> Trajectory:
        """Return the ground-truth trajectory: the pose of the middle row of each color image."""
        times_s = self.stamps_ns / 1e9
        return Trajectory(times_s, self._motion.poses(times_s))

    def row_poses(self, index: int, *, shift_s: float = 0.0) -> np.ndarray:
        """Return T_world_camera [H, 4, 4] in the middle of the exposure of each color image row.

        Args:
            index: Index of the frame.
            shift_s: Time that is added to the times of all rows.
        """
        readout_s = READOUT_S if self.config.effects.rolling_shutter else 0.0
        rows = (np.arange(HEIGHT_PX) - (HEIGHT_PX - 1) / 2) / (HEIGHT_PX - 1)
        return self._motion.poses(self._time_s(index) + shift_s + rows * readout_s)

    def depth_row_poses(self, index: int) -> np.ndarray:
        """Return T_world_camera [H, 4, 4] for the time at which each row of depth is measured.

        Simulated time-of-flight and stereo cameras measure all rows at the same time. Exact depth
        and Kinect v1 depth are measured row by row, like the color image.
        """
        if self.config.effects.depth in ("tof", "stereo"):
            time_s = np.full(HEIGHT_PX, self._time_s(index) + self.depth_delay_s)
            return self._motion.poses(time_s)
        return self.row_poses(index, shift_s=self.depth_delay_s)

    @property
    def depth_bias(self) -> DepthBias | None:
        """Bias of the depth camera; None if the effect `depth-bias` is off."""
        return DepthBias.of_seed(self.config.seed) if self.config.effects.depth_bias else None

    def exposure_rows(self, index: int) -> RowPoses:
        """Return the poses of the rows of a color image during its exposure."""
        half = EXPOSURE_S / 2
        return RowPoses(*(self.row_poses(index, shift_s=shift_s) for shift_s in (-half, 0.0, half)))

    # --- frames -------------------------------------------------------------------------------
    def read(self, index: int) -> RawFrame:
        """Return frame `index` from the cache, or render and cache it."""
        frame = self._frame(index)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, frame.color, frame.depth_m, 1.0, self.raw_camera)

    def true_labels(self) -> TrueLabels | None:
        """Return the ground-truth labels if the scene is the flat; None if it is the room."""
        return TrueLabels(CLASS_NAMES, self._labels) if self.config.walk == "flat" else None

    @cached_property
    def scene(self) -> Scene:
        """Scene that the camera moves through."""
        return self._walk.scene(self.config.seed)

    def exact(self, index: int, T_world_camera: np.ndarray) -> ExactImages:
        """Return the images that a perfect camera would record from given row poses.

        All rows show moving objects at their positions at the stamp of the frame, although the
        rows and the depth image are recorded earlier or later.

        Args:
            index: Index of the frame.
            T_world_camera: Poses of the image rows, [H, 4, 4].
        """
        return self.scene.render(self.raw_camera, T_world_camera, self._time_s(index))

    def _labels(self, index: int) -> FrameLabels:
        frame = self._frame(index)
        return FrameLabels(frame.class_ids, frame.instance_ids)

    def _time_s(self, index: int) -> float:
        return index / self._walk.rate_hz

    def _frame(self, index: int) -> CachedFrame:
        return self._cache.load_or_render(index, self._rendered)

    def _rendered(self, index: int) -> CachedFrame:
        effects, seed = self.config.effects, self.config.seed
        rows, depth_rows = self.row_poses(index), self.depth_row_poses(index)
        exact = self.exact(index, rows)
        later = exact if np.array_equal(rows, depth_rows) else self.exact(index, depth_rows)
        rng = np.random.default_rng([seed, 13, index])
        color = np.floor(np.clip(self._color(index, exact, rng), 0.0, 1.0) * 255 + 0.5)
        depth_m = measure(effects.depth, later.depth_m, later.light, FOCAL_PX, rng)
        if self.depth_bias is not None:
            depth_m = self.depth_bias.biased(depth_m, self.raw_camera)
        ids = self._rectified_ids(index, exact)
        return CachedFrame(color.astype(np.uint8), depth_m.astype(np.float32), *ids)

    def _rectified_ids(self, index: int, exact: ExactImages) -> tuple[np.ndarray, np.ndarray]:
        """Return the class ids and instance ids of the rectified image's pixels, each [H, W].

        The ids are compared with labels that evaluation renders from the map, with a pinhole camera
        at the true pose of the frame.
        """
        effects = self.config.effects
        if self.config.walk == "flat" and (effects.distortion or effects.rolling_shutter):
            pose = self.truth().T_world_camera[index]
            exact = self.scene.render(self.camera, pose, self._time_s(index))
        return exact.class_ids, exact.instance_ids

    def _color(self, index: int, exact: ExactImages, rng: np.random.Generator) -> np.ndarray:
        effects, light = self.config.effects, exact.light
        if effects.blur:
            light = blurred(light, exact.depth_m, self.raw_camera, self.exposure_rows(index))
        if effects.vignetting:
            light = light * vignetting(self.raw_camera)
        if effects.exposure:
            frames = range(index - MEMORY_FRAMES, index + 1)
            gains = automatic_gains(np.array([self._metered(frame) for frame in frames]))
            light = recorded(light, gains, rng)
        return light

    def _mean_light(self, index: int) -> np.ndarray:
        """Return the mean light [3] that automatic exposure measures in a frame."""
        step = METERING_STEP
        width, height = WIDTH_PX // step, HEIGHT_PX // step
        center_px = ((width - 1) / 2, (height - 1) / 2)
        camera = Camera(width, height, FOCAL_PX / step, FOCAL_PX / step, *center_px)
        time_s = self._time_s(index)
        (pose,) = self._motion.poses(np.array([time_s]))
        light = self.scene.render(camera, pose, time_s).light
        return light.reshape(-1, 3).sum(axis=0) / (width * height)
