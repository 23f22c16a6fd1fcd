"""Tests of the pairs of keyframes that are compared for a loop candidate."""

from types import SimpleNamespace
from typing import Any

import numpy as np

from ldo_service.geometry import se3
from ldo_service.loop_closing.keyframe_pairs import distant_pairs, likely_pairs, nearest_pairs

MIN_GAP_FRAMES = 100


def view(keyframe: int, frame: int, x_m: float = 0.0, words: tuple[float, ...] = (1.0,)) -> Any:
    T_odom_keyframe = se3.exp(np.array([0, 0, 0, x_m, 0, 0]))
    place = SimpleNamespace(T_odom_keyframe=T_odom_keyframe, median_depth_m=2.0)
    return SimpleNamespace(keyframe=keyframe, frame=frame, place=place, words=np.array(words))


def subgraph(*views: Any) -> Any:
    return SimpleNamespace(views=views)


def ids(pairs: Any) -> list[tuple[int, int]]:
    return [(pair[0].keyframe, pair[1].keyframe) for pair in pairs]


def relative_pose(old: Any, new: Any) -> np.ndarray:
    return se3.inverse(old.place.T_odom_keyframe) @ new.place.T_odom_keyframe


def test_pairs_of_at_most_the_gap_are_left_out() -> None:
    old, new = subgraph(view(0, 0), view(1, 30)), subgraph(view(2, 100), view(3, 131))
    assert ids(distant_pairs(old, new, MIN_GAP_FRAMES)) == [(0, 3), (1, 3)]


def test_frames_before_a_restart_of_the_camera_are_distant() -> None:
    old, new = subgraph(view(0, 900)), subgraph(view(1, 3))
    assert ids(distant_pairs(old, new, MIN_GAP_FRAMES)) == [(0, 1)]


def test_pairs_with_more_common_words_come_first() -> None:
    old = subgraph(view(0, 0, words=(3, 0)), view(1, 0, words=(0, 3)))
    new = subgraph(view(2, 50, words=(3, 3)), view(3, 500, words=(1, 2)))
    assert ids(likely_pairs(old, new, MIN_GAP_FRAMES)) == [(1, 3), (0, 3)]


def test_each_new_keyframe_has_its_nearest_distant_keyframe() -> None:
    """The keyframe 1 is nearer to 2 than 0 is, but only 90 frames before it."""
    old = subgraph(view(0, 0, x_m=0.0), view(1, 30, x_m=1.0))
    new = subgraph(view(2, 120, x_m=2.0), view(3, 140, x_m=1.5))
    assert ids(nearest_pairs(old, new, relative_pose, MIN_GAP_FRAMES)) == [(1, 3), (0, 2)]
    assert list(nearest_pairs(old, new, relative_pose, 1000)) == []


def test_pairs_without_a_known_pose_are_skipped() -> None:
    old, new = subgraph(view(0, 0), view(1, 0)), subgraph(view(2, 500), view(3, 500))

    def known_pose(a: Any, b: Any) -> np.ndarray | None:
        return relative_pose(a, b) if (a.keyframe, b.keyframe) == (1, 3) else None

    assert ids(nearest_pairs(old, new, known_pose, MIN_GAP_FRAMES)) == [(1, 3)]
