import doctest

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, se3
from ldo_service.regions.foreground import Foreground
from ldo_service.semantics import label_assignment
from ldo_service.semantics.label_assignment import (
    HIDDEN,
    UNMATCHED,
    Assignment,
    AssignmentConfig,
    Regions,
    assign_gaussians,
)
from tests.reference.assignment import assign_reference

CAMERA = Camera(64, 48, 50.0, 55.0, 31.5, 23.5)
T_CAMERA_MAP = se3.exp(np.array([0.1, -0.2, 0.05, 0.1, 0.05, 0.2]))
BOXES = np.array([[5.2, 4.1, 40.7, 30.3], [20.0, 10.0, 60.0, 45.0], [30.0, 2.0, 34.0, 6.5]])
SCORES = np.array([0.6, 0.55, 0.9])


def random_gaussians(n: int) -> np.ndarray:
    rng = np.random.default_rng(n)
    rows = rng.normal(size=(n, 16)).astype(np.float32)
    p_camera = np.stack([*rng.uniform(-1.2, 1.2, (2, n)), rng.uniform(0.5, 3, n)], axis=1)
    rows[:, :3] = se3.transform(se3.inverse(T_CAMERA_MAP), p_camera)
    rows[:, 3:6] = rng.uniform(-5, -2, (n, 3))
    return rows


def depth_image() -> np.ndarray:
    depth_m = np.random.default_rng(0).uniform(0.5, 3, (48, 64)).astype(np.float32)
    depth_m[:, ::9] = 0
    return depth_m


def foregrounds() -> list[Foreground]:
    rng = np.random.default_rng(1)
    return [
        Foreground(5, 6, rng.random((24, 30)) < 0.6),
        Foreground(10, 20, rng.random((30, 40)) < 0.8),
        Foreground(2, 30, np.zeros((0, 4), bool)),
    ]


def assign(
    rows: np.ndarray, regions: Regions, config: AssignmentConfig, threads: int = 1
) -> Assignment:
    indices = np.arange(len(rows), dtype=np.uint32)
    where = indices, CAMERA, T_CAMERA_MAP, depth_image(), regions, config
    return assign_gaussians(rows, *where, threads=threads)


def test_docstring_examples_pass() -> None:
    assert doctest.testmod(label_assignment).failed == 0


@pytest.mark.parametrize("rule", ["coverage", "iou"])
@pytest.mark.parametrize("depth_test", ["two_sided", "one_sided"])
@pytest.mark.parametrize("is_masked", [False, True])
def test_kernel_matches_reference(rule, depth_test, is_masked) -> None:
    rows, config = (
        random_gaussians(3000),
        AssignmentConfig(rule, 0.02 if rule == "iou" else 0.3, 0.5, depth_test),
    )
    masks = [part.image((48, 64)) for part in foregrounds()] if is_masked else None
    regions = (
        Regions.of_foregrounds(BOXES, SCORES, foregrounds())
        if is_masked
        else Regions.of_boxes(BOXES, SCORES)
    )
    kernel = assign(rows, regions, config)
    boxes, scores = BOXES.astype(np.float32).astype(float), SCORES.astype(np.float32)
    reference = assign_reference(
        rows, CAMERA, T_CAMERA_MAP, depth_image(), boxes, scores, masks, config
    )
    differ = kernel.regions != reference.regions  # Rounding at a threshold.
    assert np.count_nonzero(differ) <= 3
    np.testing.assert_allclose(kernel.overlaps[~differ], reference.overlaps[~differ], atol=2e-4)
    np.testing.assert_allclose(kernel.depths_m, reference.depths_m, atol=1e-5)
    for wanted in (HIDDEN, UNMATCHED, 0, 1):
        assert np.count_nonzero(kernel.regions == wanted) > 10


@pytest.mark.parametrize("count", [16, 17, 40])
def test_kernel_matches_reference_for_many_regions(count: int) -> None:
    """More regions than a vector has lanes, overlapping and partly outside of the image."""
    rng, rows = np.random.default_rng(5), random_gaussians(1500)
    low = rng.uniform(-10, 50, (count, 2))
    boxes = np.concatenate([low, low + rng.uniform(2, 25, (count, 2))], axis=1).astype(np.float32)
    scores = rng.uniform(0.2, 1, count).astype(np.float32)
    config = AssignmentConfig(max_depth_gap_m=1.0)
    kernel = assign(rows, Regions.of_boxes(boxes, scores), config)
    view = CAMERA, T_CAMERA_MAP, depth_image(), boxes.astype(float), scores, None, config
    reference = assign_reference(rows, *view)
    assert np.count_nonzero(kernel.regions != reference.regions) <= 3
    assert kernel.regions.max() >= count - 4, "the last regions match some Gaussians too"


def test_full_mask_equals_its_box() -> None:
    rows, box = random_gaussians(2000), np.array([[9.5, 7.5, 40.5, 30.5]])
    full = [Foreground(8, 10, np.ones((23, 31), bool))]
    config = AssignmentConfig(max_depth_gap_m=1.0)
    as_box = assign(rows, Regions.of_boxes(box, np.ones(1)), config)
    as_mask = assign(rows, Regions.of_foregrounds(box, np.ones(1), full), config)
    np.testing.assert_array_equal(as_box.regions, as_mask.regions)
    np.testing.assert_allclose(as_box.overlaps, as_mask.overlaps, atol=1e-4)


def test_overlapping_regions_are_ranked_by_score_then_index() -> None:
    rows, box = random_gaussians(2000), np.array([[0, 0, 63, 47]] * 3, float)
    config = AssignmentConfig(max_depth_gap_m=1.0)
    equal = assign(rows, Regions.of_boxes(box, np.array([0.5, 0.5, 0.5])), config).regions
    better = assign(rows, Regions.of_boxes(box, np.array([0.5, 0.5, 0.6])), config).regions
    assert set(equal) == {HIDDEN, UNMATCHED, 0} or set(equal) == {HIDDEN, 0}
    np.testing.assert_array_equal(better[equal == 0], 2)


def test_gaussian_behind_measured_surface_is_hidden() -> None:
    rows = np.zeros((2, 16), np.float32)
    rows[:, 2], rows[:, 3:6], rows[:, 6] = [1.0, 1.2], -4, 1
    regions = Regions.of_boxes(np.array([[0, 0, 63, 47]], float), np.ones(1))
    indices, depth_m = np.arange(2, dtype=np.uint32), np.ones((48, 64), np.float32)
    seen = assign_gaussians(rows, indices, CAMERA, np.eye(4), depth_m, regions, AssignmentConfig())
    assert seen.regions.tolist() == [0, HIDDEN]


def test_visible_gaussians_are_unmatched_without_regions() -> None:
    none = Regions.of_boxes(np.zeros((0, 4)), np.zeros(0))
    seen = assign(random_gaussians(500), none, AssignmentConfig(max_depth_gap_m=1.0))
    assert set(seen.regions.tolist()) == {HIDDEN, UNMATCHED}


@pytest.mark.parametrize("depth_test", ["two_sided", "one_sided"])
def test_non_finite_gaussians_are_hidden(depth_test) -> None:
    rows = random_gaussians(100)
    rows[::4, 4], rows[1::4, 0], rows[2::4, 0] = np.nan, np.inf, np.nan
    config = AssignmentConfig(max_depth_gap_m=9.0, depth_test=depth_test)
    seen = assign(rows, Regions.of_boxes(BOXES, SCORES), config)
    assert np.all(seen.regions[np.arange(100) % 4 < 3] == HIDDEN)


def test_point_that_rounds_past_the_image_uses_the_last_pixel() -> None:
    """The last float below 0.5, plus a half, is 1, which lies outside of the image."""
    rows, memory = np.zeros((1, 16), np.float32), np.array([[1.0, 9.0]], np.float32)
    rows[0, 2], rows[0, 3:6], rows[0, 6] = 1.0, -4, 1
    just_short = float(np.nextafter(np.float32(0.5), np.float32(0)))
    camera = Camera(1, 1, 50.0, 50.0, just_short, 0.0)
    regions = Regions.of_boxes(np.array([[0.0, 0.0, 0.0, 0.0]]), np.ones(1))
    view = rows, np.zeros(1, np.uint32), camera, np.eye(4), memory.ravel()[:1].reshape(1, 1)
    assert assign_gaussians(*view, regions, AssignmentConfig()).regions.tolist() != [HIDDEN]


def test_result_is_bitwise_equal_for_any_thread_count() -> None:
    rows, regions = random_gaussians(20_000), Regions.of_foregrounds(BOXES, SCORES, foregrounds())
    alone, many = (assign(rows, regions, AssignmentConfig(), threads) for threads in (1, 3))
    assert alone.regions.tobytes() == many.regions.tobytes()
    assert alone.overlaps.tobytes() == many.overlaps.tobytes()


@pytest.mark.parametrize(
    ("boxes", "scores", "message"),
    [
        ([[0, 0, np.nan, 1]], [1], "finite"),
        ([[5, 0, 1, 1]], [1], "x0 <= x1"),
        ([[0, 0, 1, 1]], [2], "0..1"),
        ([[0, 0, 1, 1]], [1, 1], "shape"),
    ],
)
def test_invalid_regions_raise(boxes, scores, message) -> None:
    regions = Regions.of_boxes(np.array(boxes, float), np.array(scores, float))
    with pytest.raises(ValueError, match=message):
        assign(random_gaussians(10), regions, AssignmentConfig())


def test_truncated_summed_area_table_raises() -> None:
    valid = Regions.of_foregrounds(BOXES, SCORES, foregrounds())
    truncated = Regions(valid.boxes, valid.scores, valid.rects, valid.sums[:-1])
    with pytest.raises(ValueError, match="sums must hold"):
        assign(random_gaussians(10), truncated, AssignmentConfig())


def test_unknown_rule_raises_config_error() -> None:
    with pytest.raises(ConfigError, match="coverage"):
        AssignmentConfig(rule="all")  # type: ignore[arg-type]


def test_one_sided_depth_test_also_accepts_gaussians_in_front_of_the_surface() -> None:
    rows = np.zeros((3, 16), np.float32)
    rows[:, 2], rows[:, 3:6], rows[:, 6] = [0.5, 1.05, 1.2], -4, 1
    regions = Regions.of_boxes(np.array([[0, 0, 63, 47]], float), np.ones(1))
    look = rows, np.arange(3, dtype=np.uint32), CAMERA, np.eye(4)
    depth_m = np.ones((48, 64), np.float32)
    one_sided = AssignmentConfig(depth_test="one_sided")
    measured = assign_gaussians(*look, depth_m, regions, one_sided)
    assert measured.regions.tolist() == [0, 0, HIDDEN]
    assert measured.overlaps[2] == 0
    unmeasured = assign_gaussians(*look, np.zeros_like(depth_m), regions, one_sided)
    assert unmeasured.regions.tolist() == [HIDDEN] * 3


def test_unknown_depth_test_is_refused() -> None:
    with pytest.raises(ConfigError, match=r"depth_test='both' must be 'two_sided' or 'one_sided'"):
        AssignmentConfig(depth_test="both")  # type: ignore[arg-type]
