"""Whether two views of a place call it by the same name."""

from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import RgbdFrame, se3

NEAREST_M = 0.05  # in front of the second camera
SAME_SURFACE = 0.02  # difference of depths, of the depth


@dataclass(frozen=True, eq=False, slots=True)
class Correspondences:
    """Pixels [M] of two views that show the same place, as indices into their rows end to end."""

    first: np.ndarray
    second: np.ndarray


@dataclass(frozen=True, slots=True)
class Agreement:
    """Pixels of pairs of views."""

    same: int = 0  # an object in either, and by the same name in both
    objects: int = 0  # an object in either

    def __add__(self, other: "Agreement") -> "Agreement":
        return Agreement(self.same + other.same, self.objects + other.objects)

    @property
    def share(self) -> float:
        """NaN where nothing is an object: background alone would always agree."""
        return self.same / self.objects if self.objects else float("nan")


def correspondences(
    first: RgbdFrame, second: RgbdFrame, T_second_first: np.ndarray
) -> Correspondences:
    """Where the pixels of one view are in another one.

    T_second_first  [4, 4], from camera to camera

    A pixel goes where its measured depth and the poses say, to the nearest pixel of the second
    view, and counts if the depth measured there is its own to 2 %: the same surface.
    """
    camera, measured = second.camera, np.flatnonzero(first.depth_m)
    points = first.camera.backproject(first.depth_m).reshape(-1, 3)[measured]
    p_second = se3.transform(T_second_first, points)
    ahead = p_second[:, 2] > NEAREST_M
    measured, p_second = measured[ahead], p_second[ahead]
    u, v = np.rint(camera.project(p_second)).astype(np.int64).T
    inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    there = v[inside] * camera.width + u[inside]
    gaps = np.abs(second.depth_m.ravel()[there] / p_second[inside, 2] - 1)
    is_same = gaps < SAME_SURFACE
    return Correspondences(measured[inside][is_same], there[is_same])


def agreement(first: np.ndarray, second: np.ndarray, pixels: Correspondences) -> Agreement:
    """Of two images of labels [H, W]; 0 is background."""
    here, there = first.ravel()[pixels.first], second.ravel()[pixels.second]
    objects = (here > 0) | (there > 0)
    return Agreement(int(np.sum((here == there) & objects)), int(np.sum(objects)))
