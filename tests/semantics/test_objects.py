"""Objects of a room with exact solids, perfect detections and the components of the mapper."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.errors import ConfigError
from ldo_service.geometry import se3
from ldo_service.semantics.data_association import AssociationConfig, MapView
from ldo_service.semantics.gaussian_labels import fields
from ldo_service.semantics.object_landmarks import entropies, reliable_members, rows_of
from ldo_service.semantics.objects import Objects
from ldo_service.semantics.objects_config import ObjectsConfig

from .scenes import (
    CAMERA,
    NAMES,
    NO_DETECTIONS,
    SCENE_OBJECTS,
    SHELL,
    LabelledMap,
    RegionDetections,
    SceneObject,
    Shot,
    poses,
    shoot,
    true_objects,
)

COUCH, VASE, BALL = SCENE_OBJECTS[0], SCENE_OBJECTS[2], SCENE_OBJECTS[5]
FRONT_POSE = poses(1)[0]


PATH = poses(40)


def true_gaussians(
    labelled_map: LabelledMap, objects: tuple[SceneObject, ...], path: np.ndarray
) -> np.ndarray:
    return true_objects(labelled_map.builder.gaussians.means, objects, path)


@pytest.fixture(scope="module")
def mapped_room() -> LabelledMap:
    labelled_map = LabelledMap()
    for _ in labelled_map.walk(SCENE_OBJECTS, PATH):
        pass
    return labelled_map


def test_each_object_is_found_once_at_its_position(mapped_room: LabelledMap) -> None:
    landmarks, object_index = (
        mapped_room.objects.landmarks,
        true_gaussians(mapped_room, SCENE_OBJECTS, PATH),
    )
    means = mapped_room.builder.gaussians.means
    centers = np.array([means[object_index == k].mean(axis=0) for k in range(len(SCENE_OBJECTS))])
    off_m = np.linalg.norm(landmarks["centroid"][:, None] - centers, axis=2)
    nearest = np.argmin(off_m, axis=1)
    assert sorted(nearest) == list(range(len(SCENE_OBJECTS)))
    assert [SCENE_OBJECTS[k].label for k in nearest] == landmarks["labels"][:, 0].tolist()
    assert off_m.min(axis=1).max() < 0.1


def test_object_boxes_match_true_solids(mapped_room: LabelledMap) -> None:
    for landmark in mapped_room.objects.landmarks:
        name = NAMES.name(int(landmark["labels"][0]))
        of_name = [item.solid for item in SCENE_OBJECTS if item.name == name]
        center = landmark["T_map_object"][:3, 3]
        solid = min(of_name, key=lambda s: np.linalg.norm(np.array(s.center_m) - center))
        assert np.linalg.norm(solid.center_m - center) < 0.2, name
        axes = landmark["T_map_object"][:3, :3]
        np.testing.assert_allclose(axes @ axes.T, np.eye(3), atol=1e-9)
        # The back sides of the objects were never observed.
        volume, true_volume = np.prod(landmark["size"]), np.prod(solid.size_m)
        assert 0.25 * true_volume < volume < 1.75 * true_volume, name


def test_object_counts_keyframes_that_observed_it(mapped_room: LabelledMap) -> None:
    shots = [shoot(SCENE_OBJECTS, T) for T in PATH]
    for item in (VASE, BALL):
        number = SCENE_OBJECTS.index(item) + 1
        shown = sum(np.count_nonzero(s.instances == number) >= 40 for s in shots)
        (landmark,) = [k for k in mapped_room.objects.landmarks if k["labels"][0] == item.label]
        # The border of the image may leave too few pixels visible.
        assert shown - 3 <= landmark["seen"] <= shown
        assert landmark["missed"] == 0
        views = landmark["view_keyframes"]
        assert len(set(views.tolist())) == 3
        assert views.min() >= 0
        assert np.all(np.diff(landmark["view_scores"]) <= 0)


def test_members_have_the_label_of_their_object(mapped_room: LabelledMap) -> None:
    gaussians = mapped_room.builder.gaussians
    for landmark in mapped_room.objects.landmarks[:, None]:
        rows = rows_of(landmark["members"][reliable_members(landmark)], gaussians.ids)
        ids = fields(mapped_room.labels())["ids"][rows[rows >= 0], 0]
        assert np.mean(ids == landmark["labels"][0, 0]) > 0.97


def test_restored_objects_continue_bitwise_equal() -> None:
    reference, restored = LabelledMap(), LabelledMap()
    path = poses(10)
    updates = list(reference.walk(SCENE_OBJECTS, path))
    restored_updates = list(restored.walk(SCENE_OBJECTS, path[:5]))
    restored.objects = Objects.unpack(restored.objects.pack())
    restored_updates += list(restored.walk(SCENE_OBJECTS, path[5:]))
    for name in ("landmarks", "counts"):
        np.testing.assert_array_equal(reference.objects.pack()[name], restored.objects.pack()[name])
    for one, other in zip(updates, restored_updates, strict=True):
        assert (one.created, one.merged, one.removed) == (
            other.created,
            other.merged,
            other.removed,
        )
        for a, b in zip(one.observations, other.observations, strict=True):
            assert (a.object, a.entropy, a.is_miss) == (b.object, b.entropy, b.is_miss)
            np.testing.assert_array_equal(a.box, b.box)


def test_state_of_another_version_raises() -> None:
    packed = Objects().pack()
    with pytest.raises(ValueError, match="another version of the service wrote it"):
        Objects.unpack({**packed, "landmarks": np.zeros((1, 8), np.uint8)})


# --- confirmation ---------------------------------------------------------------------------------
def observe_from_front(
    labelled_map: LabelledMap, objects: tuple[SceneObject, ...], keyframes: int
) -> list:
    return list(labelled_map.walk(objects, np.tile(FRONT_POSE, (keyframes, 1, 1))))


def test_object_is_confirmed_at_the_third_keyframe() -> None:
    labelled_map = LabelledMap()
    updates = observe_from_front(labelled_map, (BALL,), 4)
    assert [update.created for update in updates] == [(), (), (0,), ()]
    assert [len(update.observations) for update in updates] == [0, 0, 0, 1]
    seen = updates[3].observations[0]
    true = shoot((BALL,), FRONT_POSE).detections((BALL,)).boxes[0]
    np.testing.assert_array_equal(seen.box, true)
    assert seen.distribution[BALL.label] > 0.9
    assert not seen.is_miss


def test_region_with_changing_labels_is_never_confirmed() -> None:
    labelled_map, names = LabelledMap(), ("chair", "vase", "tv", "bed", "cup", "book")
    for name in names:
        shot = shoot((BALL,), FRONT_POSE, labelled_map.keyframe)
        detections = shot.detections((replace(BALL, name=name),))
        assert labelled_map.show(shot, detections)[1].created == ()
    assert len(labelled_map.objects) == 0


def test_region_with_too_few_gaussians_makes_no_candidate() -> None:
    labelled_map = LabelledMap(Objects(ObjectsConfig(AssociationConfig(min_gaussians=5000))))
    observe_from_front(labelled_map, (BALL,), 4)
    assert labelled_map.objects.metrics()["object_candidates"] == 0


def test_candidates_and_objects_stay_below_their_limits() -> None:
    labelled_map = LabelledMap(Objects(ObjectsConfig(max_objects=1, max_candidates=1)))
    for _ in labelled_map.walk(SCENE_OBJECTS, poses(8)):
        counts = labelled_map.objects.metrics()
        assert counts["objects"] <= 1
        assert counts["object_candidates"] <= 1


# --- late labels ----------------------------------------------------------------------------------
def late_view(labelled_map: LabelledMap, thing: SceneObject, keyframe: int) -> MapView:
    """Return a view of an object as seen in an earlier keyframe."""
    shot = shoot((thing,), FRONT_POSE, keyframe)
    return replace(labelled_map.view(shot, shot.detections((thing,))), keyframe=keyframe)


def test_late_view_counts_once_for_a_candidate_and_not_for_an_object() -> None:
    labelled_map = LabelledMap()
    labelled_map.show(shoot((BALL,), FRONT_POSE, 0), NO_DETECTIONS)
    order = (1, 1, 3, 2, 0, 9)  # 1 again and 2 lie within the candidate's first to last keyframe.
    updates = [
        labelled_map.objects.observe(late_view(labelled_map, BALL, k), is_late=True) for k in order
    ]
    assert [update.created for update in updates] == [(), (), (), (), (0,), ()]
    assert not any(update.observations or update.removed for update in updates)
    (ball,) = labelled_map.objects.landmarks
    assert (ball["seen"], ball["first"], ball["last"]) == (3, 0, 3)


def test_late_candidate_is_kept_where_the_table_is_full() -> None:
    labelled_map = LabelledMap(Objects(ObjectsConfig(max_candidates=1)))
    labelled_map.keyframe = 50
    shot = shoot((VASE,), FRONT_POSE, 50)
    labelled_map.show(shot, shot.detections((VASE,)))
    labelled_map.show(shoot((BALL,), FRONT_POSE, 51), NO_DETECTIONS)
    for keyframe in (1, 2, 3):
        view = late_view(labelled_map, BALL, keyframe)
        update = labelled_map.objects.observe(view, is_late=True)
    assert update.created == (0,)


# --- misses ---------------------------------------------------------------------------------------
def test_missing_object_is_removed_after_ten_keyframes() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (BALL, VASE), 5)
    kept = {int(k["labels"][0]): int(k["id"]) for k in labelled_map.objects.landmarks}
    updates = observe_from_front(labelled_map, (VASE,), 12)
    assert [update.removed for update in updates] == [()] * 9 + [(kept[BALL.label],)] + [()] * 2
    assert labelled_map.objects.landmarks["id"].tolist() == [kept[VASE.label]]
    misses = [
        seen.is_miss
        for update in updates
        for seen in update.observations
        if seen.object == kept[BALL.label]
    ]
    assert misses == [True] * 10


def test_uncertain_object_is_removed_earlier() -> None:
    config = ObjectsConfig(uncertain_entropy=0.0)
    labelled_map = LabelledMap(Objects(config))
    observe_from_front(labelled_map, (BALL,), 5)
    updates = observe_from_front(labelled_map, (), 6)
    assert [update.removed for update in updates] == [(), (), (), (), (0,), ()]


def test_nine_misses_in_a_row_do_not_remove_an_object() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (COUCH,), 4)
    for _ in range(9):
        shot = shoot((COUCH,), FRONT_POSE, labelled_map.keyframe)
        assert labelled_map.show(shot, NO_DETECTIONS)[1].removed == ()
    observe_from_front(labelled_map, (COUCH,), 1)
    (landmark,) = labelled_map.objects.landmarks
    assert (landmark["misses"], landmark["missed"]) == (0, 9)


def test_object_below_minimum_size_is_not_missed() -> None:
    labelled_map = LabelledMap(Objects(ObjectsConfig(min_side_px=40)))
    observe_from_front(labelled_map, (BALL,), 4)
    labelled_map.show(shoot((BALL,), FRONT_POSE, labelled_map.keyframe), NO_DETECTIONS)
    assert labelled_map.objects.landmarks["missed"].tolist() == [0]


def test_object_out_of_view_or_hidden_is_not_missed() -> None:
    labelled_map, screen = (
        LabelledMap(),
        replace(SHELL, center_m=(0, -0.3, 1.0), size_m=(3.0, 0.1, 2.0)),
    )
    observe_from_front(labelled_map, (BALL,), 4)
    hidden = observe_from_front(labelled_map, (BALL, SceneObject("refrigerator", screen)), 3)
    turned = FRONT_POSE @ np.diag([-1.0, 1, -1, 1])
    away = list(labelled_map.walk((BALL,), np.tile(turned, (3, 1, 1))))
    for update in (*hidden, *away):
        assert 0 not in [seen.object for seen in update.observations]


# --- merging --------------------------------------------------------------------------------------
def half_detection(shot: Shot, left: bool) -> RegionDetections:
    """Return a detection of the left or right half of the ball."""
    v, u = np.nonzero(shot.instances)
    middle = (u.min() + u.max()) / 2
    ends = (u.min() - 0.5, middle) if left else (middle, u.max() + 0.5)
    box = np.array([[ends[0], v.min() - 0.5, ends[1], v.max() + 0.5]])
    return RegionDetections.of_detector(box, np.array([BALL.label]), np.array([0.9], np.float32))


def test_objects_of_two_halves_merge_when_the_whole_is_detected() -> None:
    labelled_map = LabelledMap()
    for left in (True, False):
        for _ in range(3):
            shot = shoot((BALL,), FRONT_POSE, labelled_map.keyframe)
            labelled_map.show(shot, half_detection(shot, left))
    assert labelled_map.objects.landmarks["id"].tolist() == [0, 1]
    updates = observe_from_front(labelled_map, (BALL,), 3)
    assert [pair for update in updates for pair in update.merged] == [(1, 0)]
    (landmark,) = labelled_map.objects.landmarks
    assert landmark["id"] == 0
    assert landmark["first"] == 0
    true = labelled_map.builder.gaussians.means[
        true_gaussians(labelled_map, (BALL,), FRONT_POSE[None]) == 0
    ]
    assert np.linalg.norm(landmark["centroid"] - true.mean(axis=0)) < 0.05


def with_parts(shot: Shot, scores: tuple[float, ...]) -> RegionDetections:
    """Return detections of the ball, its upper half and, given a third score, its lower half."""
    v, u = np.nonzero(shot.instances)
    x0, y0, x1, y1 = u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5
    middle = (y0 + y1) / 2
    boxes = np.array([[x0, y0, x1, y1], [x0, y0, x1, middle], [x0, middle, x1, y1]])
    n = len(scores)
    return RegionDetections.of_detector(
        boxes[:n], np.full(n, BALL.label), np.array(scores, np.float32)
    )


@pytest.mark.parametrize("scores", [(0.6, 0.9), (0.95, 0.9, 0.8), (0.6, 0.9, 0.8)])
def test_object_detected_in_parts_is_one_object(scores: tuple[float, ...]) -> None:
    labelled_map, boxes = LabelledMap(), []
    for _ in range(6):
        shot = shoot((BALL,), FRONT_POSE, labelled_map.keyframe)
        detections = with_parts(shot, scores)
        _, update = labelled_map.show(shot, detections)
        boxes += [(seen.box, detections.boxes[0]) for seen in update.observations]
    (landmark,) = labelled_map.objects.landmarks
    assert landmark["seen"] == 6
    assert labelled_map.objects.metrics()["object_candidates"] == 0
    assert boxes
    for seen, whole in boxes:
        np.testing.assert_array_equal(seen, whole)
    members = np.isin(labelled_map.builder.gaussians.ids, landmark["members"])
    heights = labelled_map.builder.gaussians.means[members, 2]
    assert heights.min() < 0.15 < 0.25 < heights.max()  # Members come from both halves.


def test_neighboring_objects_of_one_class_are_not_merged() -> None:
    other = replace(BALL, solid=replace(BALL.solid, center_m=(0.42, 0.9, 0.2)))
    labelled_map = LabelledMap()
    updates = observe_from_front(labelled_map, (BALL, other), 8)
    assert len(labelled_map.objects) == 2
    assert not any(update.merged for update in updates)


# --- corrections ----------------------------------------------------------------------------------
def test_objects_move_with_their_gaussians() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (BALL, VASE), 4)
    gaussians, before = labelled_map.builder.gaussians, labelled_map.objects.landmarks
    T = se3.exp(np.array([0.1, -0.2, 0.3, 1.0, 0.5, -0.2]))
    motions = {int(k): T for k in np.unique(gaussians.anchors)}
    labelled_map.builder.move_keyframes(motions)
    labelled_map.objects.move(motions)
    moved = labelled_map.objects.landmarks
    expected = se3.transform(T, before["centroid"])
    np.testing.assert_allclose(moved["centroid"], expected, atol=1e-9)
    labelled_map.objects.refresh(
        gaussians.rows, labelled_map.labels(), gaussians.ids, gaussians.anchors
    )
    after = labelled_map.objects.landmarks
    # More than rounding: boxes, and with them the outliers, may change their axes.
    np.testing.assert_allclose(after["centroid"], expected, atol=0.02)
    assert after["id"].tolist() == before["id"].tolist()


def test_refresh_updates_only_objects_within_view() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (BALL, VASE), 4)
    gaussians, before = labelled_map.builder.gaussians, labelled_map.objects.landmarks
    rows = gaussians.rows.copy()
    rows[:, 0] += 0.01
    now = rows, labelled_map.labels(), gaussians.ids, gaussians.anchors
    away = FRONT_POSE @ np.diag([-1.0, 1, -1, 1])
    labelled_map.objects.refresh(*now, seen_from=(CAMERA, away))
    np.testing.assert_array_equal(labelled_map.objects.landmarks, before)
    labelled_map.objects.refresh(*now, seen_from=(CAMERA, FRONT_POSE))
    moved_m = labelled_map.objects.landmarks["centroid"] - before["centroid"]
    np.testing.assert_allclose(moved_m, np.tile([0.01, 0, 0], (2, 1)), atol=2e-3)


def test_object_of_unknown_class_is_missed_only_when_its_place_is_empty() -> None:
    labelled_map, undetectable = (
        LabelledMap(Objects(ObjectsConfig(min_side_px=10))),
        np.zeros(256, bool),
    )
    observe_from_front(labelled_map, (BALL,), 4)
    undetectable[BALL.label] = True
    for present, missed in (((BALL,), 0), ((), 1)):
        shot = shoot(present, FRONT_POSE, labelled_map.keyframe)
        labelled_map.builder.add(shot.frame, shot.T_map_camera, labelled_map.keyframe, 0)
        labelled_map.objects.observe(labelled_map.view(shot, NO_DETECTIONS), undetectable)
        labelled_map.keyframe += 1
        assert labelled_map.objects.landmarks["missed"].tolist() == [missed]


def test_objects_with_offloaded_gaussians_are_not_changed() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (BALL,), 4)
    before = labelled_map.objects.landmarks
    no_rows = labelled_map.builder.gaussians.rows[:0]
    labelled_map.objects.refresh(
        no_rows, labelled_map.labels()[:0], np.zeros(0, np.int64), np.zeros(0, np.int32)
    )
    np.testing.assert_array_equal(labelled_map.objects.landmarks, before)
    assert entropies(before)[0] < 0.5


def test_objects_in_view_stay_if_no_gaussian_is_in_memory() -> None:
    labelled_map = LabelledMap()
    observe_from_front(labelled_map, (BALL,), 4)
    before = labelled_map.objects.landmarks
    seen = labelled_map.view(shoot((BALL,), FRONT_POSE), NO_DETECTIONS)
    names = "rows", "labels", "ids", "anchors", "indices", "regions"
    empty = {name: getattr(seen, name)[:0] for name in names}
    assert not labelled_map.objects.observe(replace(seen, **empty)).observations
    np.testing.assert_array_equal(labelled_map.objects.landmarks, before)


@pytest.mark.parametrize(
    "fields_", [{"min_keyframes": 0}, {"max_divergence": -1}, {"merge_overlap": 0}]
)
def test_invalid_limits_raise_config_error(fields_: dict) -> None:
    with pytest.raises(ConfigError, match="must"):
        ObjectsConfig(**fields_)
