"""Precision, recall and errors of loop closures of a camera before a wall, with known truth."""

import numpy as np
import pytest

from ldo_service.evaluation.loops import (
    ComparedPair,
    FoundLoops,
    LoopClosed,
    SeenKeyframe,
    evaluate_loops,
    overlap,
    seen_keyframes,
)
from ldo_service.geometry import Camera

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
WIDTH_IN_VIEW_M = 2 * 160 / 150  # Width of the wall in view, from 2 m.


def keyframe_at(x_m: float, id: int = 0, frame: int = 0, turned: bool = False) -> SeenKeyframe:
    """Return a keyframe 2 m before the wall, facing it or turned away."""
    T = np.diag([-1.0, 1, -1, 1]) if turned else np.eye(4)
    T[0, 3] = x_m
    return SeenKeyframe(id, frame, T, CAMERA, np.full((120, 160), 2.0, np.float32))


def walk(*places: tuple[float, int]) -> dict[int, SeenKeyframe]:
    """Return keyframes by id; a place is the x of a keyframe in meters, and its frame number."""
    return {k: keyframe_at(x_m, k, frame) for k, (x_m, frame) in enumerate(places)}


# Three keyframes at the start, three far away, and three at the start again.
THERE_AND_BACK = walk(
    *((0.0, 0), (0.1, 5), (0.2, 10)),
    *((9.0, 150), (9.1, 155), (9.2, 160)),
    *((0.1, 300), (0.2, 305), (0.3, 310)),
)
FIRST, AWAY, AGAIN = (0, 1, 2), (3, 4, 5), (6, 7, 8)


def true_pose(reference: int, keyframe: int) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = THERE_AND_BACK[keyframe].T_world_camera[0, 3]
    T[0, 3] -= THERE_AND_BACK[reference].T_world_camera[0, 3]
    return T


def compared(newer: tuple[int, ...], older: tuple[int, ...], is_closure: bool) -> ComparedPair:
    return ComparedPair(newer, older, is_closure, ms=20.0)


@pytest.mark.parametrize("fraction", [0.0, 0.25, 0.5, 1.0])
def test_overlap_is_the_fraction_of_the_wall_that_both_see(fraction: float) -> None:
    first, second = keyframe_at(0), keyframe_at((1 - fraction) * WIDTH_IN_VIEW_M)
    assert overlap(second, first) == pytest.approx(fraction, abs=0.03)
    assert overlap(first, second) == pytest.approx(fraction, abs=0.03)


def test_keyframe_turned_away_has_no_overlap() -> None:
    assert overlap(keyframe_at(0), keyframe_at(0, turned=True)) == 0


def test_correct_closure_has_full_precision_and_recall() -> None:
    found = FoundLoops(
        (compared(AGAIN, FIRST, True), compared(AGAIN, AWAY, False)),
        (LoopClosed(7, 2, true_pose(2, 7)),),
    )
    errors = evaluate_loops(found, THERE_AND_BACK)
    assert (errors.precision, errors.recall, errors.retrieved_queries) == (1, 1, 1)
    assert (errors.queries, errors.candidates) == (1, 2)
    assert errors.position_errors_m == (0,)
    assert errors.ms == (20, 20)


def test_false_closure_lowers_precision_and_adds_no_recall() -> None:
    T = true_pose(4, 7)
    T[1, 3] = 0.3
    found = FoundLoops((compared(AGAIN, AWAY, True),), (LoopClosed(7, 4, T),))
    errors = evaluate_loops(found, THERE_AND_BACK)
    assert (errors.precision, errors.recall, errors.retrieved_queries) == (0, 0, 0)
    assert errors.position_errors_m == pytest.approx((0.3,))


def test_true_pair_that_was_compared_and_rejected_is_retrieved() -> None:
    errors = evaluate_loops(FoundLoops((compared(AGAIN, FIRST, False),), ()), THERE_AND_BACK)
    assert (errors.recall, errors.retrieved_queries) == (0, 1)


def test_true_pair_that_was_never_compared_is_missed() -> None:
    errors = evaluate_loops(FoundLoops((), ()), THERE_AND_BACK)
    assert (errors.precision, errors.recall, errors.queries) == (None, 0, 1)


def test_keyframes_that_are_close_in_time_are_no_loop() -> None:
    near = walk(*((0.0, 10 * k) for k in range(8)))
    errors = evaluate_loops(FoundLoops((), ()), near)
    assert (errors.queries, errors.recall) == (0, None)


def test_keyframes_of_a_source_are_subsampled(room) -> None:
    truth = room.truth()
    seen = seen_keyframes({0: 0, 1: 6}, room, truth)
    assert seen[1].depth_m.shape == (120, 160)
    np.testing.assert_allclose(seen[1].T_world_camera, truth.T_world_camera[6])
    full, small = room.camera.rays()[1::2, 1::2], seen[1].camera.rays()
    np.testing.assert_allclose(small, full)
    assert overlap(seen[1], seen[0]) > 0.5
