"""Which region of a keyframe each Gaussian belongs to (paper, III.A).

The kernel is `kernels/assignment.hpp`; `tests/reference/assignment.py` implements it in NumPy.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera
from ldo_service.kernels import _labels
from ldo_service.regions.foreground import Foreground

HIDDEN, UNMATCHED = -2, -1  # in place of a region


@dataclass(frozen=True, slots=True)
class AssignmentConfig:
    # The paper's IoU of box and Gaussian labels next to nothing: a splat is a few pixels, a box
    # hundreds. Coverage is their intersection over the splat.
    rule: Literal["coverage", "iou"] = "coverage"
    min_overlap: float = 0.3  # theta_IoU (III.A)
    max_depth_gap_m: float = 0.1  # delta_z (III.A)

    def __post_init__(self) -> None:
        if self.rule not in ("coverage", "iou"):
            raise ConfigError(f"rule={self.rule!r} must be 'coverage' or 'iou'.")
        if not (0 <= self.min_overlap <= 1 and self.max_depth_gap_m > 0):
            raise ConfigError(
                named(self, "min_overlap", "max_depth_gap_m")
                + ": min_overlap in 0..1, max_depth_gap_m positive."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Regions:
    """M regions of an image.

    boxes  [M, 4] float32, x0 y0 x1 y1, px
    scores [M] float32, 0..1: where regions overlap, the larger overlap times score wins
    rects  [M, 4] int32, column, row, width, height of what `sums` covers; width 0: all of the box
    sums   [S] int32, summed-area tables [height + 1, width + 1], one after the other
    """

    boxes: np.ndarray
    scores: np.ndarray
    rects: np.ndarray
    sums: np.ndarray

    @classmethod
    def of_boxes(cls, boxes: np.ndarray, scores: np.ndarray) -> "Regions":
        return cls(*_float32(boxes, scores), np.zeros((len(boxes), 4), np.int32), _NO_SUMS)

    @classmethod
    def of_foregrounds(
        cls, boxes: np.ndarray, scores: np.ndarray, foregrounds: Sequence[Foreground]
    ) -> "Regions":
        """Of each box only that part; one without any pixel keeps no Gaussian."""
        shown = [f if f.mask.size else _NOWHERE for f in foregrounds]
        rects = [(f.column, f.row, f.mask.shape[1], f.mask.shape[0]) for f in shown]
        sums = [cv2.integral(f.mask.view(np.uint8)).ravel() for f in shown]
        rects = np.array(rects, np.int32).reshape(-1, 4)
        return cls(*_float32(boxes, scores), rects, np.concatenate([_NO_SUMS, *sums]))


@dataclass(frozen=True, eq=False, slots=True)
class Assignment:
    """regions  [V] int32: number of the region; UNMATCHED; or HIDDEN: out of the image, or not at
                the depth that was measured there
    overlaps [V] float32, with that region, by the rule; 0 without one
    depths_m [V] float32
    """

    regions: np.ndarray
    overlaps: np.ndarray
    depths_m: np.ndarray


def assign_gaussians(
    rows: np.ndarray,
    indices: np.ndarray,
    camera: Camera,
    T_camera_map: np.ndarray,
    depth_m: np.ndarray,
    regions: Regions,
    config: AssignmentConfig,
    *,
    threads: int = 1,
) -> Assignment:
    """Match Gaussians with regions.

    Each is projected, S = J R Sigma R' J' + 0.3 px^2 I as it is rendered, and has the axis-aligned
    box of two standard deviations about its centre, cut to the image. It is expected if its centre
    lies in the image and is within max_depth_gap_m of depth_m there. A region gets it if

        overlap > min_overlap,  overlap = |splat * region| / |splat|, or by `iou` / |splat + region|

    and by `coverage`, if the centre too lies in the region: where depth was tested. Of several the
    one with the largest overlap times score does, of equals the first.

    rows         [N, 16] float32 of the map
    indices      [V] uint32, ascending: those to look at, as `Contributions.indices`
    camera       without distortion, of depth_m [H, W] float32, 0 where not measured
    T_camera_map [4, 4]
    Raises ValueError for arrays that do not fit. Bitwise equal for any number of threads.

    A splat of sigma 1 px at (2, 5), whose box is [0, 4] x [3, 7], is half covered by a region that
    begins at x = 2. They share 8 px^2 of 16 and 64:

    >>> camera, depth_m = Camera(20, 10, 10.0, 10.0, 2.0, 5.0), np.ones((10, 20), np.float32)
    >>> row = np.zeros((1, 16), np.float32)
    >>> row[0, 2], row[0, 3:6], row[0, 6] = 1, np.log(np.sqrt(0.7) / 10), 1
    >>> region = Regions.of_boxes(np.array([[2, 1, 10, 9]]), np.ones(1))
    >>> look = row, np.zeros(1, np.uint32), camera, np.eye(4), depth_m, region
    >>> by_share = assign_gaussians(*look, AssignmentConfig())
    >>> int(by_share.regions[0]), round(float(by_share.overlaps[0]), 4)
    (0, 0.5)
    >>> by_iou = assign_gaussians(*look, AssignmentConfig("iou", min_overlap=0.1))
    >>> round(float(by_iou.overlaps[0]), 4)  # 8 / (16 + 64 - 8)
    0.1111
    """
    v = len(indices)
    out = Assignment(np.empty(v, np.int32), np.empty(v, np.float32), np.empty(v, np.float32))
    _labels.assign(
        rows,
        indices,
        np.ascontiguousarray(np.asarray(T_camera_map)[:3], np.float32),
        camera.fx,
        camera.fy,
        camera.cx,
        camera.cy,
        depth_m,
        regions.boxes,
        regions.scores,
        regions.rects,
        regions.sums,
        config.rule == "iou",
        config.min_overlap,
        config.max_depth_gap_m,
        out.regions,
        out.overlaps,
        out.depths_m,
        threads,
    )
    return out


_NO_SUMS = np.zeros(0, np.int32)
_NOWHERE = Foreground(0, 0, np.zeros((1, 1), bool))


def _float32(boxes: np.ndarray, scores: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return np.ascontiguousarray(boxes, np.float32), np.ascontiguousarray(scores, np.float32)
