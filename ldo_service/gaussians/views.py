"""Frames that the map is optimised against, and which of them an iteration takes."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ldo_service.geometry import Camera, RgbdFrame, se3

from .exposure import Exposure


@dataclass(frozen=True, eq=False, slots=True)
class View:
    """A keyframe as the loss reads it.

    keyframe      its id
    camera        without distortion
    color         [3, H, W] uint8
    depth_m       [H, W] float32, 0 where not measured
    T_map_camera  [4, 4]
    mask          [H, W] uint8, 0 where the pixel does not count; None: all do
    """

    keyframe: int
    camera: Camera
    color: np.ndarray
    depth_m: np.ndarray
    T_map_camera: np.ndarray
    exposure: Exposure = field(default_factory=Exposure)
    mask: np.ndarray | None = None

    @classmethod
    def of(cls, frame: RgbdFrame, T_map_camera: np.ndarray, keyframe: int) -> "View":
        planes = np.ascontiguousarray(frame.color.transpose(2, 0, 1))
        return cls(keyframe, frame.camera, planes, frame.depth_m, T_map_camera)


def shared_surface(
    newest: View, camera: Camera, T_map_camera: np.ndarray, *, step_px: int = 32
) -> float:
    """Share of the surface measured in `newest` that lies in the image of another camera, in
    front of it; of every `step_px`-th pixel. Occlusion is not looked at."""
    coarse = slice(step_px // 2, None, step_px)
    z = newest.depth_m[coarse, coarse]
    points = newest.camera.rays()[coarse, coarse][z > 0] * z[z > 0][:, None]
    if len(points) == 0:
        return 0.0
    points = se3.transform(se3.inverse(T_map_camera) @ newest.T_map_camera, points)
    points = points[points[:, 2] > 0.05]
    u, v = camera.project(points).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return float(np.count_nonzero(inside)) / np.count_nonzero(z > 0)


def schedule(
    newest: int,
    covisible: Sequence[int],
    others: Sequence[int],
    iterations: int,
    rng: np.random.Generator,
    *,
    newest_share: float,
    covisible_share: float,
) -> list[int]:
    """Which keyframe each iteration takes.

    About `newest_share` of the iterations take the newest, the first among them, and
    `covisible_share` one of `covisible`; the rest take one of `others`. The newest stands in where
    a list is empty.
    """
    out = []
    draws = rng.random(iterations)
    draws[: newest_share > 0] = 0
    for draw in draws:
        if draw < newest_share:
            choice: Sequence[int] = ()
        elif draw < newest_share + covisible_share:
            choice = covisible
        else:
            choice = others
        out.append(choice[int(rng.integers(len(choice)))] if choice else newest)
    return out
