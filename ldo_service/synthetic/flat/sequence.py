"""Sequences through three buildings, with a parallel renderer that fills their cache.

`flat` is a furnished flat of two rooms, `twins` are four equal offices along a corridor, and
`corridor` is a long corridor with weak texture.
"""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache, partial
from multiprocessing import get_context
from pathlib import Path
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import FrameLabels, Sequence, TrueLabels

from .cache import CachedFrame, FrameCache
from .corridor import corridor_walk, furnished_corridor
from .render import FlatRenderer
from .scene import Flat, furnished_flat
from .scene_object import CLASS_NAMES, SceneObject
from .sensor import Sensor
from .twins import furnished_twins
from .twins_walk import twins_walk
from .walk import RATE_HZ, CameraPath, hand_held


@dataclass(frozen=True, slots=True)
class ScenePlan:
    """Building and walk of a sequence, both as functions of the seed."""

    # Part of the cache's identity; change it if a change alters a byte of any frame.
    version: str
    furnish: Callable[[int], Flat]
    walk: Callable[[int], CameraPath]


PLANS = {
    "flat": ScenePlan("1", furnished_flat, hand_held),
    "twins": ScenePlan("twins 2", furnished_twins, twins_walk),
    "corridor": ScenePlan("corridor 1", furnished_corridor, corridor_walk),
}
# Focal length in image widths: a horizontal field of view of 63 degrees, as in a Kinect.
FOCAL_PER_WIDTH = 0.8125
# The working width of the tracker. Long walks have smaller images, which are rendered faster.
LONG_WIDTH_PX, LONG_HEIGHT_PX = 320, 240


@dataclass(frozen=True, slots=True)
class FlatConfig:
    """Parameters of a rendered sequence; equal parameters give bitwise equal images."""

    width_px: int = 640
    height_px: int = 480
    # True adds motion blur, exposure drift, noise and a Kinect's depth errors.
    noise: bool = True
    seed: int = 0  # Seed of textures, materials, hand shake and noise.
    # Building: the furnished `flat`, `twins`, four equal offices, or `corridor`.
    scene: Literal["flat", "twins", "corridor"] = field(default="flat", repr=False)

    def __post_init__(self) -> None:
        if self.width_px < 16 or self.height_px < 16:
            raise ConfigError(
                f"images of synthetic:{self.scene} have {self.width_px}x{self.height_px} pixels, "
                "but must have at least 16x16 pixels."
            )
        if self.seed < 0:
            raise ConfigError(f"synthetic:{self.scene}: seed={self.seed} must be at least 0.")


NAMED = {
    "flat": FlatConfig(),
    "flat-exact": FlatConfig(noise=False),
    "twins": FlatConfig(LONG_WIDTH_PX, LONG_HEIGHT_PX, scene="twins"),
    "twins-exact": FlatConfig(LONG_WIDTH_PX, LONG_HEIGHT_PX, noise=False, scene="twins"),
    "corridor": FlatConfig(LONG_WIDTH_PX, LONG_HEIGHT_PX, scene="corridor"),
    "corridor-exact": FlatConfig(LONG_WIDTH_PX, LONG_HEIGHT_PX, noise=False, scene="corridor"),
}


class FlatSequence(Sequence):
    """Walk through a labelled scene at 15 Hz; each frame is rendered once and cached."""

    class_names = CLASS_NAMES  # Names of the class ids.

    def __init__(self, config: FlatConfig | None = None, name: str = "flat") -> None:
        self.config = config = config or FlatConfig()
        focal_px = FOCAL_PER_WIDTH * config.width_px
        center_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
        camera = Camera(config.width_px, config.height_px, focal_px, focal_px, *center_px)
        self._plan = PLANS[config.scene]
        self._walk = self._plan.walk(config.seed)
        frames = self._walk.frames
        super().__init__(name, camera, np.arange(frames, dtype=np.int64) * 10**9 // RATE_HZ)
        self._sensor = Sensor(camera, self._walk, config.seed)
        self._T_world_camera = np.array([self._walk.pose(frame) for frame in range(frames)])
        self._cache = FrameCache(
            f"{self._plan.version} {config}", config.width_px, config.height_px
        )

    @staticmethod
    def named(name: str, **changes: int | bool) -> "FlatSequence":
        """Return the sequence `synthetic:NAME`, with the config fields in `changes` replaced.

        Raises:
            DataError: If the name is unknown.
        """
        if name not in NAMED:
            raise DataError(f"unknown sequence synthetic:{name}. Choose one of {', '.join(NAMED)}.")
        config = replace(NAMED[name], **changes)
        seed = f"@{config.seed}" if config.seed else ""
        return FlatSequence(config, f"synthetic:{name}{seed}")

    @property
    def cache_folder(self) -> Path:
        """Folder of the cached frames."""
        return self._cache.folder

    @cached_property
    def things(self) -> tuple[SceneObject, ...]:
        """Objects in the world frame; instance id i is `things[i - 1]`, id 0 is the building."""
        return self._flat.things

    def read(self, index: int) -> RawFrame:
        """Return frame `index` from the cache, or render and cache it."""
        frame = self._frame(index)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, frame.color, frame.depth_m, 1.0, self.raw_camera)

    def labels(self, index: int) -> FrameLabels:
        """Return the ground-truth class and instance per pixel of frame `index`.

        Labels are exact even where depth is noisy or missing.
        """
        frame = self._frame(index)
        return FrameLabels(frame.class_ids, frame.instance_ids)

    def true_labels(self) -> TrueLabels:
        """Return the class names, and a function that returns a frame's ground-truth labels."""
        return TrueLabels(CLASS_NAMES, self.labels)

    def truth(self) -> Trajectory:
        """Return the ground-truth trajectory."""
        return Trajectory(self.stamps_ns / 1e9, self._T_world_camera.copy())

    @cached_property
    def _flat(self) -> Flat:
        return self._plan.furnish(self.config.seed)

    @cached_property
    def _renderer(self) -> FlatRenderer:
        return FlatRenderer(self._flat)

    def _frame(self, index: int) -> CachedFrame:
        return self._cache.load_or_render(index, self._rendered)

    def _rendered(self, index: int) -> CachedFrame:
        exact = self._renderer.render(self.raw_camera, self._T_world_camera[index])
        light, depth_m = exact.light, exact.depth_m
        if self.config.noise:
            rng = np.random.default_rng([self.config.seed, 4, index])
            light = self._sensor.color(index, exact, rng)
            depth_m = self._sensor.depth_m(exact, rng)
        color = np.floor(np.clip(light, 0.0, 1.0) * 255 + 0.5).astype(np.uint8)
        return CachedFrame(color, depth_m.astype(np.float32), exact.class_ids, exact.instance_ids)


def prerender(
    config: FlatConfig,
    processes: int,
    frames: range | None = None,
    advance: Callable[[int], None] | None = None,
) -> None:
    """Render all frames that are missing in the cache, in several processes.

    One process needs about one second for a frame of 640x480 pixels.

    Args:
        config: Parameters of the sequence.
        processes: Number of processes.
        frames: Indices of the frames; None for all.
        advance: Callback that receives the number of finished frames.
    """
    indices = range(len(FlatSequence(config))) if frames is None else frames
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(partial(_read, config), indices), 1):
            if advance is not None:
                advance(done)


def _read(config: FlatConfig, index: int) -> None:
    _sequence(config).read(index)


@lru_cache(maxsize=1)
def _sequence(config: FlatConfig) -> FlatSequence:
    """Return the sequence, built once per process because its furniture takes a second to build."""
    return FlatSequence(config)
