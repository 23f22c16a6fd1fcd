"""Binding of the label kernels, `kernels/labels.hpp`."""

import numpy as np
from numpy.typing import NDArray

def assign(
    rows: NDArray[np.float32],
    indices: NDArray[np.uint32],
    T_camera_map: NDArray[np.float32],
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    depth_m: NDArray[np.float32],
    boxes: NDArray[np.float32],
    scores: NDArray[np.float32],
    rects: NDArray[np.int32],
    sums: NDArray[np.int32],
    by_iou: bool,
    min_overlap: float,
    max_depth_gap_m: float,
    max_front_gap_m: float,
    region: NDArray[np.int32],
    overlap: NDArray[np.float32],
    z: NDArray[np.float32],
    threads: int = 1,
) -> None:
    """Match each of the Gaussians `indices` with one of M regions of an image.

    The function releases the GIL. The result is bitwise equal for any number of threads.
    `ldo_service.semantics.label_assignment` describes the rule.

    Args:
        rows: Gaussians of the map, [N, 16].
        indices: Rows to assign, [V], ascending.
        T_camera_map: Upper rows of the transform from the map to the camera, [3, 4].
        fx: Focal length, pixels.
        fy: Focal length, pixels.
        cx: Principal point, pixels.
        cy: Principal point, pixels.
        depth_m: Depth of the image, [H, W], meters; 0 where not measured.
        boxes: Boxes x0 y0 x1 y1 of the regions, [M, 4], pixels.
        scores: Scores of the regions, [M], 0..1.
        rects: Column, row, width and height of the rectangle that each region's mask covers,
            [M, 4]. A region whose rectangle has width 0 has no mask and covers its whole box.
        sums: Summed-area tables [height + 1, width + 1] of the masks, one after the other.
        by_iou: True if the overlap is the IoU of region and splat. If False, it is the fraction of
            the splat that the region covers.
        min_overlap: Overlap that a region must exceed.
        max_depth_gap_m: Maximum distance of a Gaussian behind the measured surface, meters.
        max_front_gap_m: Maximum distance of a Gaussian in front of it, meters; may be infinite.
        region: Output, [V]: number of the matched region; -1 for no region, -2 for a Gaussian that
            is not expected in the image.
        overlap: Output, [V]: overlap with the matched region.
        z: Output, [V]: depth of the Gaussian, meters.
        threads: Number of threads.

    Raises:
        ValueError: An array has the wrong shape, type or strides, indices do not ascend, or a
            number is out of range.
    """

def update(
    labels: NDArray[np.uint8],
    indices: NDArray[np.uint32],
    observed: NDArray[np.int16],
    confidence: NDArray[np.float32],
    extent_m: NDArray[np.float32],
    is_corrected: bool,
    keep: float,
    miss_weight: float,
    miss_limit: int,
    usual_extent_m: float,
    hold_back: float,
    threads: int = 1,
) -> None:
    """Update the label rows `indices` by one observation each, in place.

    The function releases the GIL. The result is bitwise equal for any number of threads.
    `ldo_service.semantics.gaussian_labels` describes the rules and their settings.

    Args:
        labels: Label rows, [N, 32] bytes, changed in place.
        indices: Rows to update, [V], ascending.
        observed: Observed labels, [V]; -1 for a miss, -2 for no observation.
        confidence: Confidences of the labels, [V], 0..1.
        extent_m: Size of the object with the label, [V], meters. For a miss, the minimum size that
            an object must have to count as missed.
        is_corrected: True to use the corrected moving average, False to use that of the paper.
        keep: Factor on earlier observations, in [0, 1).
        miss_weight: Weight of a miss as an observation of background, 0..1.
        miss_limit: Misses in a row that reset a row to background, for the paper's average.
        usual_extent_m: Assumed size of an object whose size is unknown, meters.
        hold_back: Damping, 0..1, of low-confidence observations of Gaussians with low entropy.
        threads: Number of threads.

    Raises:
        ValueError: An array has the wrong shape, type or strides, indices do not ascend, or a
            number is out of range.
    """

def agree(
    rows: NDArray[np.float32],
    labels: NDArray[np.uint8],
    indices: NDArray[np.uint32],
    sigma_m: float,
    radius_m: float,
    rate: float,
    threads: int = 1,
) -> tuple[float, float]:
    """Move the label distributions of the rows `indices` towards their neighbors, in place.

    The function releases the GIL. The result is bitwise equal for any number of threads.
    `ldo_service.semantics.gaussian_labels` describes the step.

    Args:
        rows: Gaussians of the map, [N, 16].
        labels: Label rows, [N, 32] bytes, changed in place.
        indices: Rows to update, [V], ascending; neighbors are among them.
        sigma_m: Length scale of the weights, meters.
        radius_m: Maximum distance of a neighbor, meters.
        rate: Size of the step, 0..1.
        threads: Number of threads.

    Returns:
        Two measures of the disagreement between neighbors before the step, as weighted sums over
        all pairs: the first counts pairs with different top labels, the second is the probability
        that two labels drawn from their distributions differ.

    Raises:
        ValueError: An array has the wrong shape, type or strides, indices do not ascend, or a
            number is out of range.
    """
