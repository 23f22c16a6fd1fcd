"""The flat as a sequence, and all of its frames rendered into the cache by several processes."""

from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import FrameLabels, Sequence, TrueLabels

from .cache import CachedFrame, FrameCache
from .render import FlatRenderer
from .scene import Flat, furnished_flat
from .scene_object import CLASS_NAMES, SceneObject
from .sensor import Sensor
from .walk import FRAMES, RATE_HZ, hand_held

VERSION = 1  # raise it with every change that alters a byte of any frame
FOCAL_PER_WIDTH = 0.8125  # 63 degrees wide, as a Kinect's colour camera


@dataclass(frozen=True, slots=True)
class FlatConfig:
    """What is rendered. The same values give the same bytes."""

    width_px: int = 640
    height_px: int = 480
    noise: bool = True  # blur, exposure and a Kinect's depth; sharp and exact otherwise
    seed: int = 0  # of textures and paints, of the hand's shaking and of the noise

    def __post_init__(self) -> None:
        if self.width_px < 16 or self.height_px < 16:
            raise ConfigError(
                f"synthetic flat of {self.width_px}x{self.height_px} pixels: at least 16x16 is "
                "needed."
            )
        if self.seed < 0:
            raise ConfigError(f"seed {self.seed} of a synthetic flat: 0 or more is needed.")


NAMED = {"flat": FlatConfig(), "flat-exact": FlatConfig(noise=False)}


class FlatSequence(Sequence):
    """A walk through the flat, 43 s at 15 Hz; frames are rendered once, then come from the disk.

    class_names   names of the class ids
    things        objects; instance id i is things[i - 1], id 0 the building
    """

    class_names = CLASS_NAMES

    def __init__(self, config: FlatConfig | None = None, name: str = "flat") -> None:
        self.config = config = config or FlatConfig()
        focal_px = FOCAL_PER_WIDTH * config.width_px
        center_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
        camera = Camera(config.width_px, config.height_px, focal_px, focal_px, *center_px)
        super().__init__(name, camera, np.arange(FRAMES, dtype=np.int64) * 10**9 // RATE_HZ)
        self._walk = hand_held(config.seed)
        self._sensor = Sensor(camera, self._walk, config.seed)
        self._T_world_camera = np.array([self._walk.pose(frame) for frame in range(FRAMES)])
        self._cache = FrameCache(f"{VERSION} {config}", config.width_px, config.height_px)

    @staticmethod
    def named(name: str, **changes: int | bool) -> "FlatSequence":
        """The sequence `synthetic:name`, its config changed by keywords. Raises DataError."""
        if name not in NAMED:
            raise DataError(f"there is no synthetic:{name} among the flats {', '.join(NAMED)}.")
        config = replace(NAMED[name], **changes)
        seed = f"@{config.seed}" if config.seed else ""
        return FlatSequence(config, f"synthetic:{name}{seed}")

    @property
    def cache_folder(self) -> Path:
        """Where its rendered frames are kept."""
        return self._cache.folder

    @cached_property
    def things(self) -> tuple[SceneObject, ...]:
        """The objects in the world."""
        return self._flat.things

    def read(self, index: int) -> RawFrame:
        frame = self._frame(index)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, frame.color, frame.depth_m, 1.0, self.raw_camera)

    def labels(self, index: int) -> FrameLabels:
        """True class and instance per pixel of frame `index`, exact even where depth is not."""
        frame = self._frame(index)
        return FrameLabels(frame.class_ids, frame.instance_ids)

    def true_labels(self) -> TrueLabels:
        return TrueLabels(CLASS_NAMES, self.labels)

    def truth(self) -> Trajectory:
        return Trajectory(self.stamps_ns / 1e9, self._T_world_camera.copy())

    @cached_property
    def _flat(self) -> Flat:
        return furnished_flat(self.config.seed)

    @cached_property
    def _renderer(self) -> FlatRenderer:
        return FlatRenderer(self._flat)

    def _frame(self, index: int) -> CachedFrame:
        frame = self._cache.load(index)
        if frame is None:
            frame = self._rendered(index)
            self._cache.store(index, frame)
        return frame

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
    """Render those of `frames` (None: all) that are not cached yet: about a second per frame of
    640x480 and process. `advance` is called with the number of frames done."""
    indices = range(len(FlatSequence(config))) if frames is None else frames
    with ProcessPoolExecutor(processes, mp_context=get_context("spawn")) as pool:
        for done, _ in enumerate(pool.map(partial(_read, config), indices), 1):
            if advance is not None:
                advance(done)


def _read(config: FlatConfig, index: int) -> None:
    _sequence(config).read(index)


@lru_cache(maxsize=1)
def _sequence(config: FlatConfig) -> FlatSequence:
    """Made once in a process: its furniture takes a second."""
    return FlatSequence(config)
