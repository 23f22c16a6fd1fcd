"""Assignment of Gaussians to the regions of a keyframe (LDO-SLAM paper, III.A).

The C++ implementation is `kernels/assignment.hpp`. The tests compare it with the NumPy
implementation `tests/reference/assignment.py`.
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

HIDDEN, UNMATCHED = -2, -1  # Values in place of a region's number; see `Assignment`.


@dataclass(frozen=True, slots=True)
class AssignmentConfig:
    """Settings of the assignment of Gaussians to regions."""

    # Measure of the overlap of a splat and a region. `iou` is the measure of the LDO-SLAM paper. It
    # labels almost no Gaussian, because a splat is a few pixels wide and a box is hundreds of
    # pixels wide. `coverage` is the area of the intersection divided by the area of the splat.
    rule: Literal["coverage", "iou"] = "coverage"
    min_overlap: float = 0.3  # Minimum overlap: theta_IoU (LDO-SLAM paper, III.A).
    # Maximum difference between the depth of a Gaussian and the measured depth: delta_z
    # (LDO-SLAM paper, III.A).
    max_depth_gap_m: float = 0.1
    # `two_sided` accepts a Gaussian only at the measured depth. `one_sided`, the test of the
    # paper, also accepts a Gaussian in front of the measured surface.
    depth_test: Literal["two_sided", "one_sided"] = "two_sided"

    def __post_init__(self) -> None:
        if self.depth_test not in ("two_sided", "one_sided"):
            raise ConfigError(
                f"AssignmentConfig.depth_test={self.depth_test!r} must be 'two_sided' or "
                "'one_sided'."
            )
        if self.rule not in ("coverage", "iou"):
            raise ConfigError(f"AssignmentConfig.rule={self.rule!r} must be 'coverage' or 'iou'.")
        if not (0 <= self.min_overlap <= 1 and self.max_depth_gap_m > 0):
            raise ConfigError(
                named(self, "min_overlap", "max_depth_gap_m")
                + ": min_overlap must be in [0, 1], max_depth_gap_m positive."
            )


@dataclass(frozen=True, eq=False, slots=True)
class Regions:
    """M regions of an image.

    Attributes:
        boxes: Boxes, [M, 4] float32, x0 y0 x1 y1, pixels.
        scores: Scores, [M] float32, 0..1. A Gaussian in several regions is assigned to the region
            with the largest product of overlap and score.
        rects: Rectangle of the image that the mask of each region covers: column, row, width and
            height, [M, 4] int32, pixels. A region of width 0 has no mask and is its whole box.
        sums: Summed-area tables of all masks, flattened and concatenated, int32. The table of a
            mask has the shape [height + 1, width + 1].
    """

    boxes: np.ndarray
    scores: np.ndarray
    rects: np.ndarray
    sums: np.ndarray

    @classmethod
    def of_boxes(cls, boxes: np.ndarray, scores: np.ndarray) -> "Regions":
        """Return regions that are whole boxes.

        Args:
            boxes: Boxes, [M, 4], x0 y0 x1 y1, pixels.
            scores: Scores, [M], 0..1.
        """
        return cls(*_float32(boxes, scores), np.zeros((len(boxes), 4), np.int32), _NO_SUMS)

    @classmethod
    def of_foregrounds(
        cls, boxes: np.ndarray, scores: np.ndarray, foregrounds: Sequence[Foreground]
    ) -> "Regions":
        """Return regions that are the foreground pixels of their boxes.

        A region whose foreground has no pixels is assigned no Gaussians.

        Args:
            boxes: Boxes, [M, 4], x0 y0 x1 y1, pixels.
            scores: Scores, [M], 0..1.
            foregrounds: Foreground of each box.
        """
        shown = [f if f.mask.size else _NOWHERE for f in foregrounds]
        rects = [(f.column, f.row, f.mask.shape[1], f.mask.shape[0]) for f in shown]
        sums = [cv2.integral(f.mask.view(np.uint8)).ravel() for f in shown]
        rects = np.array(rects, np.int32).reshape(-1, 4)
        return cls(*_float32(boxes, scores), rects, np.concatenate([_NO_SUMS, *sums]))


@dataclass(frozen=True, eq=False, slots=True)
class Assignment:
    """Assignment of V Gaussians to the regions of an image.

    Attributes:
        regions: Number of the region of each Gaussian, [V] int32. UNMATCHED means that the Gaussian
            is in no region. HIDDEN means that it is outside the image or failed the depth test.
        overlaps: Overlap of each Gaussian with its region, [V] float32, 0..1; 0 if it has none.
            `AssignmentConfig.rule` selects the measure: IoU, or the covered fraction of the splat.
        depths_m: Depths of the Gaussians in the camera frame, [V] float32, meters.
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
    """Assign Gaussians to the regions of an image.

    Each Gaussian is projected as in rendering, with the image covariance J R Sigma R' J' +
    0.3 px^2 I. Its splat is the axis-aligned box of two standard deviations around the projected
    center, clipped to the image. A Gaussian is HIDDEN if its center is outside the image or not
    finite. It is also HIDDEN if its depth differs by max_depth_gap_m or more from the measured
    depth at the center. With the depth test `one_sided`, this applies only to Gaussians behind the
    measured depth. Any other Gaussian may be assigned to a region if overlap > min_overlap:

        rule `coverage`:  overlap = area(splat and region) / area(splat)
        rule `iou`:       overlap = area(splat and region) / area(splat or region)

    With `coverage`, the center of the Gaussian must also lie in the region, because the depth is
    tested only at the center. Of several possible regions, the Gaussian gets the region with the
    largest product of overlap and score; if the products are equal, the first region. The result is
    bitwise equal for any number of threads.

    Args:
        rows: Gaussians of the map, [N, 16] float32, see `gaussians.rows`.
        indices: Row numbers of the V Gaussians to assign, [V] uint32, ascending; see
            `Contributions.indices`.
        camera: Intrinsics of the depth image, without distortion.
        T_camera_map: Transform from the map to the camera, [4, 4].
        depth_m: Measured depth, [H, W] float32, meters; 0 where unknown.
        regions: Regions of the image.
        config: Settings of the assignment.
        threads: Number of threads.

    Returns:
        The region of each Gaussian.

    Raises:
        ValueError: An array has a wrong shape or type.

    Example: a Gaussian has a standard deviation of 1 px and its center at pixel (2, 5). Its splat
    is [0, 4] x [3, 7] and has 16 px^2. A region of 64 px^2 begins at x = 2 and covers 8 px^2 of it:

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
        config.max_depth_gap_m if config.depth_test == "two_sided" else np.inf,
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
