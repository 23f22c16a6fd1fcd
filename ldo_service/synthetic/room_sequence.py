"""Sequence of the synthetic room, optionally with the depth errors of a Kinect."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import Camera, RawFrame, Trajectory
from ldo_service.geometry.sequence import Sequence

from . import path
from .person import person_at
from .room import furnished_room
from .room_render import Renderer, RoomRendering

# Khoshelham and Elberink, Sensors 2012: depth is 1 / (step * disparity), with disparity in whole
# steps. One step of disparity is therefore 2.85e-3 z^2 m of depth. The matching error is half a
# step.
DISPARITY_STEP_PER_M = 2.85e-3
DISPARITY_SIGMA_STEPS = 0.5
NEAREST_M, FARTHEST_M = 0.4, 8.0

RATE_HZ = 30
# Focal length in image widths: a horizontal field of view of 63 degrees, as in a Kinect.
FOCAL_PER_WIDTH = 0.8125

PATHS = {"look_around": path.LOOK_AROUND, "tour": path.TOUR, "linger": path.LINGER}


def kinect_depth(depth_m: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return depth with the errors of a Kinect.

    Depth has steps that grow with the square of depth: 3 mm at 1 m, 26 mm at 3 m. The noise
    of the pattern matching is half a step.

    Args:
        depth_m: Exact depth [H, W], meters.
        rng: Source of the noise of the pattern matching.

    Returns:
        Measured depth [H, W], meters; 0 outside 0.4 to 8 m and in the projector's shadow.
    """
    disparity = 1 / (depth_m * DISPARITY_STEP_PER_M)
    disparity = disparity + DISPARITY_SIGMA_STEPS * rng.standard_normal(depth_m.shape)
    measured = 1 / (np.maximum(np.floor(disparity + 0.5), 1.0) * DISPARITY_STEP_PER_M)
    seen = (measured >= NEAREST_M) & (measured <= FARTHEST_M) & ~_is_shadowed(depth_m)
    return np.where(seen, measured, 0.0)


def _is_shadowed(depth_m: np.ndarray) -> np.ndarray:
    """Return a mask [H, W] of the pixels that the light of the Kinect's projector does not reach.

    These pixels are on the far side of depth jumps along a row.
    """
    jump = np.diff(depth_m, axis=1, prepend=depth_m[:, :1])
    return jump > 0.05 * depth_m


@dataclass(frozen=True, slots=True)
class SyntheticConfig:
    """Parameters of a rendered sequence; equal parameters give bitwise equal images."""

    frames: int = 120
    width_px: int = 320
    height_px: int = 240
    # Path of the camera through the room.
    path: Literal["look_around", "tour", "linger"] = "look_around"
    noise: bool = False  # True adds the depth errors of a Kinect; False gives exact depth.
    person: bool = False  # True adds a person who walks through the room.
    seed: int = 0  # Seed of the textures, the hand shake and the noise.

    def __post_init__(self) -> None:
        if self.frames < 1 or self.width_px < 8 or self.height_px < 8:
            raise ConfigError(
                f"the synthetic sequence has {self.frames} frames of "
                f"{self.width_px}x{self.height_px} pixels, but must have at least 1 frame of 8x8 "
                "pixels."
            )
        if self.path not in PATHS:
            raise ConfigError(
                f"synthetic sequence: path={self.path!r} must be one of {', '.join(PATHS)}."
            )


NAMED = {
    "room": SyntheticConfig(),
    "room-noisy": SyntheticConfig(noise=True),
    "tour": SyntheticConfig(frames=360, path="tour"),
    "tour-noisy": SyntheticConfig(frames=360, path="tour", noise=True),
    "person": SyntheticConfig(frames=240, path="linger", person=True),
    "person-noisy": SyntheticConfig(frames=240, path="linger", person=True, noise=True),
}


class SyntheticSequence(Sequence):
    """Sequence of the furnished room. Each read renders the frame; depth is float32 in meters."""

    def __init__(self, config: SyntheticConfig | None = None, name: str = "synthetic") -> None:
        self.config = config = config or SyntheticConfig()
        focal_px = FOCAL_PER_WIDTH * config.width_px
        center_px = ((config.width_px - 1) / 2, (config.height_px - 1) / 2)
        camera = Camera(config.width_px, config.height_px, focal_px, focal_px, *center_px)
        stamps_ns = np.arange(config.frames, dtype=np.int64) * 10**9 // RATE_HZ
        super().__init__(name, camera, stamps_ns)
        self._T_world_camera = path.poses(PATHS[config.path], config.frames, config.seed)
        self._renderer = Renderer(furnished_room(config.seed))

    @staticmethod
    def named(name: str, **changes: int | bool) -> "SyntheticSequence":
        """Return the sequence `synthetic:NAME`, with the config fields in `changes` replaced.

        Raises:
            DataError: If the name is unknown.
        """
        if name not in NAMED:
            known = ", ".join(f"synthetic:{known}" for known in NAMED)
            raise DataError(f"unknown sequence synthetic:{name}. Choose one of {known}.")
        config = replace(NAMED[name], **changes)
        seed = f"@{config.seed}" if config.seed else ""
        return SyntheticSequence(config, f"synthetic:{name}{seed}")

    def read(self, index: int) -> RawFrame:
        """Render frame `index`."""
        exact = self._rendering(index)
        depth_m = exact.depth_m
        if self.config.noise:
            depth_m = kinect_depth(depth_m, np.random.default_rng([self.config.seed, index]))
        depth = depth_m.astype(np.float32)
        stamp_ns = int(self.stamps_ns[index])
        return RawFrame(index, stamp_ns, exact.color, depth, 1.0, self.raw_camera)

    def person(self, index: int) -> np.ndarray:
        """Return a mask [H, W] of the person in frame `index`, exact at pixel centers."""
        return self._rendering(index).is_visitor

    def _rendering(self, index: int) -> RoomRendering:
        visitors = person_at(index / RATE_HZ) if self.config.person else ()
        return self._renderer.render(self.raw_camera, self._T_world_camera[index], visitors)

    def truth(self) -> Trajectory:
        """Return the ground-truth trajectory."""
        return Trajectory(self.stamps_ns / 1e9, self._T_world_camera.copy())
