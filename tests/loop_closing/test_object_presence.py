"""Objects that depth images show to be present, missing or hidden at a relative pose."""

from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from ldo_service.geometry import Camera
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.loop_closing.object_presence import (
    MapLandmarks,
    ObjectPresence,
    ObjectPresenceChecker,
    count_replaced,
    ray_fractions,
)

CAMERA = Camera(160, 120, 150.0, 150.0, 79.5, 59.5)
WALL_M, BALL_M, RADIUS_M = 3.0, 2.0, 0.2
ASIDE_M = 0.7  # Distance of the second ball from the optical axis.


def depth_of(*centers_m: tuple[float, float, float]) -> np.ndarray:
    """Return the depth image [H, W] of balls in front of a wall, in meters."""
    rays = CAMERA.rays()
    depth_m = np.full((CAMERA.height, CAMERA.width), WALL_M)
    for center in centers_m:
        dd, dc = np.sum(rays * rays, axis=-1), rays @ np.array(center)
        inside = dc**2 - dd * (np.dot(center, center) - RADIUS_M**2)
        depth_m = np.where(inside > 0, (dc - np.sqrt(np.maximum(inside, 0))) / dd, depth_m)
    return depth_m.astype(np.float32)


def landmarks(*centers_m: tuple[float, float, float], label: int = 0) -> MapLandmarks:
    """Return balls with the covariance of a uniform distribution on their surface."""
    return MapLandmarks(
        np.array(centers_m, float).reshape(-1, 3),
        np.tile(RADIUS_M**2 / 3 * np.eye(3), (len(centers_m), 1, 1)),
        np.tile(np.eye(3)[label], (len(centers_m), 1)),
    )


AHEAD, ASIDE = (0.0, 0.0, BALL_M), (ASIDE_M, 0.0, BALL_M)


@dataclass(frozen=True, eq=False)
class View:
    """Keyframe of a subgraph."""

    keyframe: int
    place: Any


GRAY = np.full((CAMERA.height, CAMERA.width), 128, np.uint8)


def subgraph(first: int, *depths_m: np.ndarray, gray: np.ndarray = GRAY) -> Any:
    views = [
        View(first + k, SimpleNamespace(depth_m=depth, gray_image=gray, camera=CAMERA))
        for k, depth in enumerate(depths_m)
    ]
    return SimpleNamespace(views=views)


def poses_of(*T_map: np.ndarray) -> KeyframePoses:
    poses = KeyframePoses()
    for k, T in enumerate(T_map):
        poses.add(k, None, np.eye(4), T)
    return poses


def shift(x_m: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


def presence(old_depth_m: np.ndarray, new_depth_m: np.ndarray, objects: MapLandmarks) -> tuple:
    """Return the numbers of tests and of missing objects of two views from one place."""
    old, new = subgraph(0, old_depth_m), subgraph(1, new_depth_m)
    found = ObjectPresenceChecker().check(
        objects, old, new, np.eye(4), poses_of(np.eye(4), np.eye(4))
    )
    return found.tested, found.missing


def test_rays_hit_a_ball_and_pass_through_the_place_of_a_removed_one() -> None:
    hit, through = ray_fractions(landmarks(AHEAD, ASIDE), depth_of(AHEAD), CAMERA)
    assert hit[0] > 0.95
    assert through[0] < 0.05
    assert through[1] == 1
    assert hit[1] == 0


def test_hidden_unmeasured_and_outside_objects_give_no_information() -> None:
    near_wall = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    beside, behind = (3.0, 0.0, BALL_M), (0.0, 0.0, -BALL_M)
    for objects, depth_m in (
        (landmarks(AHEAD), near_wall),
        (landmarks(AHEAD), np.zeros_like(near_wall)),
        (landmarks(beside, behind), depth_of()),
    ):
        assert np.max(ray_fractions(objects, depth_m, CAMERA)) == 0


def test_flat_object_on_the_wall_is_hit() -> None:
    picture = MapLandmarks(
        np.array([[0.0, 0, WALL_M]]), np.diag([0.04, 0.04, 0])[None], np.ones((1, 1))
    )
    hit, through = ray_fractions(picture, depth_of(), CAMERA)
    assert (hit[0], through[0]) == (1, 0)


@pytest.mark.parametrize(
    ("contrast", "is_in_both", "missing"), [(60, False, 1), (60, True, 0), (4, False, 0)]
)
def test_flat_object_is_missing_if_the_images_do_not_correlate(
    contrast: int, is_in_both: bool, missing: int
) -> None:
    """A clock on the wall has two dark quarters. Depth shows the wall at both places."""
    clock = MapLandmarks(
        np.array([[0.0, 0, WALL_M]]), np.diag([0.04, 0.04, 0])[None], np.ones((1, 1))
    )
    noise = np.random.default_rng(0).integers(126, 131, GRAY.shape)
    v, u = np.indices(GRAY.shape)
    shown = noise + contrast * ((u > 79) ^ (v > 59))
    other = shown if is_in_both else np.random.default_rng(1).integers(126, 131, GRAY.shape)
    old = subgraph(0, depth_of(), gray=shown.astype(np.uint8))
    new = subgraph(1, depth_of(), gray=other.astype(np.uint8))
    poses = poses_of(np.eye(4), np.eye(4))
    found = ObjectPresenceChecker().check(clock, old, new, np.eye(4), poses)
    assert (found.tested, found.missing) == (2, missing)


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ((AHEAD, ASIDE), (AHEAD, ASIDE), (4, 0)),  # Each ball is tested in both directions.
        ((AHEAD, ASIDE), (AHEAD,), (3, 1)),
        ((AHEAD,), (AHEAD, ASIDE), (3, 1)),
        ((), (), (0, 0)),
    ],
)
def test_objects_of_one_view_are_looked_for_in_the_other(old, new, expected) -> None:
    assert presence(depth_of(*old), depth_of(*new), landmarks(AHEAD, ASIDE)) == expected


def test_object_that_its_own_view_does_not_show_is_not_tested() -> None:
    """The map has the object at a wrong place, as before a correction."""
    wrong = landmarks((-ASIDE_M, 0.0, BALL_M))
    assert presence(depth_of(AHEAD), depth_of(AHEAD), wrong) == (0, 0)


def test_object_hidden_in_one_of_two_views_is_tested_in_the_other() -> None:
    near_wall = np.full((CAMERA.height, CAMERA.width), 1.0, np.float32)
    old, new = subgraph(0, depth_of(AHEAD)), subgraph(1, near_wall, depth_of())
    poses = poses_of(np.eye(4), np.eye(4), np.eye(4))
    found = ObjectPresenceChecker().check(landmarks(AHEAD), old, new, np.eye(4), poses)
    assert (found.tested, found.missing) == (1, 1)


def test_hypothesis_decides_where_the_other_views_look() -> None:
    """Two places 5 m apart show equal balls.

    A hypothesis that moves the new place by 5 m finds both balls at one place; with 5.5 m, both are
    missing.
    """
    old, new = subgraph(0, depth_of(AHEAD)), subgraph(1, depth_of(AHEAD))
    poses = poses_of(np.eye(4), shift(5.0))
    objects = landmarks(AHEAD, (5.0, 0.0, BALL_M))
    checker = ObjectPresenceChecker()
    right = checker.check(objects, old, new, shift(-5.0), poses)
    wrong = checker.check(objects, old, new, shift(-5.5), poses)
    assert (right.tested, right.missing) == (2, 0)
    assert (wrong.tested, wrong.missing) == (2, 2)


def test_views_without_a_pose_are_ignored() -> None:
    old, new = subgraph(0, depth_of(AHEAD)), subgraph(1, depth_of(), depth_of(AHEAD))
    poses = poses_of(np.eye(4), np.eye(4))  # The pose of keyframe 2 is unknown.
    found = ObjectPresenceChecker().check(landmarks(AHEAD), old, new, np.eye(4), poses)
    assert (found.tested, found.missing) == (1, 1)


def joined(a: MapLandmarks, b: MapLandmarks) -> MapLandmarks:
    return MapLandmarks(
        np.concatenate([a.p_map, b.p_map]),
        np.concatenate([a.covariance, b.covariance]),
        np.concatenate([a.distributions, b.distributions]),
    )


@pytest.mark.parametrize(("label", "replaced"), [(0, 0), (1, 1)])
def test_object_with_another_label_at_the_same_place_replaces_it(label, replaced) -> None:
    """Two places 5 m apart show equal balls, to which the map gives equal or different labels."""
    old, new = subgraph(0, depth_of(AHEAD)), subgraph(1, depth_of(AHEAD))
    objects = joined(landmarks(AHEAD), landmarks((5.0, 0.0, BALL_M), label=label))
    poses = poses_of(np.eye(4), shift(5.0))
    found = ObjectPresenceChecker().check(objects, old, new, shift(-5.0), poses)
    assert (found.tested, found.missing, found.replaced) == (2, 0, replaced)


def test_uncertain_labels_replace_nothing() -> None:
    a, b = landmarks(AHEAD), landmarks(AHEAD, label=1)
    unsure = replace(b, distributions=np.array([[0.1, 0.9, 0.0]]))
    assert count_replaced(a, b) == 1
    assert count_replaced(a, unsure) == 0, "KL(a || unsure) = log 10 = 2.3 nats"


def test_objects_side_by_side_are_not_compared() -> None:
    beside = landmarks((2.5 * RADIUS_M, 0.0, BALL_M), label=1)
    assert count_replaced(landmarks(AHEAD), beside) == 0
    assert count_replaced(landmarks(), beside) == 0


def test_nested_object_is_compared_with_the_object_of_its_size() -> None:
    """A book in a shelf, seen twice, is not compared with the shelf."""
    shelf = replace(landmarks(AHEAD, label=1), covariance=0.1 * np.eye(3)[None])
    both = joined(landmarks(AHEAD), shelf)
    assert count_replaced(both, both) == 0


def test_one_of_25_objects_may_be_missing_or_replaced() -> None:
    assert not ObjectPresence(25, 1, 0).contradicts
    assert ObjectPresence(24, 1, 0).contradicts
    assert ObjectPresence(24, 0, 1).contradicts
    assert not ObjectPresence(0, 0, 0).contradicts


def test_landmarks_of_a_snapshot_are_equal() -> None:
    objects = landmarks(AHEAD, ASIDE)
    assert objects.pack() is objects.pack()
    again = MapLandmarks.unpack(objects.pack())
    assert np.array_equal(again.p_map, objects.p_map)
    assert np.array_equal(again.covariance, objects.covariance)
    assert np.array_equal(again.distributions, objects.distributions)
    assert len(MapLandmarks.unpack(None)) == 0


def test_replaced_objects_among_many_are_counted_without_comparing_each_pair(monkeypatch) -> None:
    """A hall of 40 x 40 balls, 1 m apart, of which three have another label at the second visit."""
    x, z = np.meshgrid(np.arange(40.0), np.arange(40.0))
    centers_m = np.stack([x.ravel(), np.zeros(x.size), z.ravel()], axis=1)
    hall = landmarks(*map(tuple, centers_m.tolist()))
    changed = hall.distributions.copy()
    changed[[0, 700, 1599]] = np.eye(3)[1]
    again = replace(hall, p_map=centers_m + np.array([0.02, 0, 0]), distributions=changed)
    inverted: list[int] = []
    inverse = np.linalg.inv
    monkeypatch.setattr(np.linalg, "inv", lambda M: inverted.append(len(M)) or inverse(M))
    assert count_replaced(hall, again) == 3
    assert sum(inverted) == len(hall), "only the pairs at one place are compared"


@pytest.mark.parametrize("apart", [0.0, 1.0, 2.0, 2.3, 2.4, 3.0])
def test_objects_are_at_one_place_up_to_a_bhattacharyya_coefficient_of_a_half(apart) -> None:
    """Equal Gaussians with sigma s, d apart, have BC = exp(-d^2 / (8 s^2)): 0.5 at d = 2.35 s."""
    sigma_m = np.sqrt(RADIUS_M**2 / 3 + 0.01**2)  # The tolerance of flat objects is 1 cm.
    beside = landmarks((apart * sigma_m, 0.0, BALL_M), label=1)
    assert count_replaced(landmarks(AHEAD), beside) == (apart < 2.35)
