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


def sampled_surface(view: View, *, step_px: int = 32) -> np.ndarray:
    """Points [M, 3] in the map that a view measured, of every `step_px`-th pixel."""
    coarse = slice(step_px // 2, None, step_px)
    z = view.depth_m[coarse, coarse]
    points = view.camera.rays()[coarse, coarse][z > 0] * z[z > 0][:, None]
    return se3.transform(view.T_map_camera, points)


def shared_surface(p_map: np.ndarray, camera: Camera, T_map_camera: np.ndarray) -> float:
    """Share of points [M, 3] that lie in the image of a camera, in front of it; 0 of none.
    Occlusion is not looked at."""
    points = se3.transform(se3.inverse(T_map_camera), p_map)
    points = points[points[:, 2] > 0.05]
    u, v = camera.project(points).T
    inside = (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
    return float(np.count_nonzero(inside)) / max(len(p_map), 1)


def shown_within(
    pixels: np.ndarray, p_map: np.ndarray, camera: Camera, T_map_camera: np.ndarray
) -> np.ndarray:
    """Mask [M] of the points [M, 3] that a camera shows in `pixels`, [H, W] bool, or that something
    before them hides there."""
    p_camera = se3.transform(se3.inverse(T_map_camera), p_map)
    out = p_camera[:, 2] > 0
    u, v = np.rint(camera.project(p_camera[out])).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    inside[inside] = pixels[v[inside].astype(int), u[inside].astype(int)]
    out[out] = inside
    return out


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
