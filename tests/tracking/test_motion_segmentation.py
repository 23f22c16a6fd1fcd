"""Motion segmentation, compared with the true mask of a person in the synthetic room."""

from collections.abc import Iterable
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import open_sequence
from ldo_service.detection.dynamic_classes import Box, DynamicClassConfig, dynamic_class_mask
from ldo_service.errors import ConfigError
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Camera, RgbdFrame, Trajectory, se3
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.synthetic import SyntheticConfig, SyntheticSequence
from ldo_service.tracking import Odometry, OdometryConfig, TrackingResult, TrackingStatus
from ldo_service.tracking.keyframes import KeyframeConfig
from ldo_service.tracking.motion_segmentation import (
    MotionMasks,
    MotionSegmentationConfig,
    depth_gap_m,
    grow_mask,
    segment_motion,
)
from ldo_service.tracking.pyramid import DepthNoise, Level, Pyramid, PyramidConfig, pyramid_of

# The images have 160 pixels, as the level that is used otherwise.
CONFIG = MotionSegmentationConfig(level=0)
EMPTY, OCCUPIED = 0, 70  # Frames before the person appears and in the middle of the walk.
NOISE_SCALE = 2.0


class PersonWalk:
    """Frames of a walk past a person, rendered on request."""

    def __init__(self) -> None:
        config = SyntheticConfig(
            frames=240, width_px=160, height_px=120, path="linger", person=True, noise=True
        )
        self._sequence = SyntheticSequence(config)
        truth = self._sequence.truth()
        self._T_world_camera = truth.T_world_camera
        self._frames: dict[int, RgbdFrame] = {}

    def frame(self, k: int) -> RgbdFrame:
        if k not in self._frames:
            self._frames[k] = self._sequence[k]
        return self._frames[k]

    def view(self, k: int) -> Pyramid:
        return pyramid_of(self.frame(k), PyramidConfig())

    def person(self, k: int) -> np.ndarray:
        return self._sequence.person(k)

    def T(self, a: int, b: int) -> np.ndarray:
        return se3.inverse(self._T_world_camera[a]) @ self._T_world_camera[b]

    def segment(
        self, keyframe: int, frames: list[int], moved_mask: np.ndarray | None = None
    ) -> MotionMasks:
        """Return the masks of the last of several frames."""
        evidence, masks = None, None
        for k in frames:
            masks = segment_motion(
                self.view(k),
                self.view(keyframe),
                moved_mask,
                self.T(keyframe, k),
                NOISE_SCALE,
                evidence,
                CONFIG,
                DepthNoise(),
            )
            evidence, moved_mask = masks.evidence, masks.moved_mask
        assert masks is not None
        return masks


@pytest.fixture(scope="module")
def walk() -> PersonWalk:
    return PersonWalk()


def recall_and_precision(mask: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    hit = np.count_nonzero(mask & true)
    return hit / max(np.count_nonzero(true), 1), hit / max(np.count_nonzero(mask), 1)


def test_person_that_appears_after_the_keyframe_is_segmented(walk: PersonWalk) -> None:
    masks = walk.segment(EMPTY, [OCCUPIED - 1, OCCUPIED])
    whole = grow_mask(masks.dynamic_mask, walk.view(OCCUPIED), CONFIG)
    recall, precision = recall_and_precision(whole, walk.person(OCCUPIED))
    assert recall > 0.95
    assert precision > 0.7  # The mask includes a rim on purpose.
    assert not masks.moved_mask.any()


def test_person_that_left_is_masked_in_the_keyframe(walk: PersonWalk) -> None:
    masks = walk.segment(OCCUPIED, [230, 231])
    recall, precision = recall_and_precision(masks.moved_mask, walk.person(OCCUPIED))
    assert recall > 0.9
    assert precision > 0.9
    assert not masks.dynamic_mask.any()


def test_one_frame_alone_masks_nothing_in_the_keyframe(walk: PersonWalk) -> None:
    assert not walk.segment(OCCUPIED, [230]).moved_mask.any()


def test_moved_pixels_stay_masked_while_the_person_stands_still(walk: PersonWalk) -> None:
    person = walk.person(OCCUPIED)
    assert not walk.segment(OCCUPIED, [OCCUPIED, OCCUPIED]).dynamic_mask.any()
    masks = walk.segment(OCCUPIED, [OCCUPIED, OCCUPIED], person)
    assert recall_and_precision(masks.dynamic_mask, person)[0] > 0.9


@pytest.mark.parametrize(("keyframe", "frame"), [(0, 12), (160, 200), (200, 170)])
def test_static_room_has_empty_masks_while_the_camera_moves(
    walk: PersonWalk, keyframe: int, frame: int
) -> None:
    masks = walk.segment(keyframe, [frame, frame + 1])
    assert not masks.dynamic_mask.any()
    assert not masks.moved_mask.any()


def test_depth_gap_is_the_difference_where_both_depths_are_measured() -> None:
    camera = Camera(24, 16, 20.0, 20.0, 11.5, 7.5)
    texels = np.zeros((16, 24, 4), np.float32)
    near, far = texels.copy(), texels.copy()
    near[..., 3], far[..., 3] = 1.5, 2.0
    far[4:8, :4, 3] = 0
    T_far_near = np.eye(4)
    T_far_near[2, 3] = 0.1  # The camera of `near` is 0.1 m ahead.
    ahead = depth_gap_m(Level(near, camera), Level(far, camera), T_far_near, CONFIG)
    np.testing.assert_allclose(ahead[:, 12], 2.0 - 1.6, atol=1e-6)
    assert np.isnan(ahead[6, 1])
    behind = depth_gap_m(Level(far, camera), Level(near, camera), se3.inverse(T_far_near), CONFIG)
    np.testing.assert_allclose(behind[12, 12], 1.5 - 1.9, atol=1e-6)
    assert np.isnan(behind[6, 1])


def test_mask_grows_at_equal_depth_but_not_onto_the_wall_behind(walk: PersonWalk) -> None:
    person, view = walk.person(OCCUPIED), walk.view(OCCUPIED)
    half = person.copy()
    half[60:] = False  # The legs are missing.
    whole = grow_mask(half, view, CONFIG)
    assert recall_and_precision(whole, person)[0] > recall_and_precision(half, person)[0] + 0.05
    assert recall_and_precision(whole, person)[1] > 0.7


def test_detector_box_becomes_the_pixels_of_its_object(walk: PersonWalk) -> None:
    person, view = walk.person(OCCUPIED), walk.view(OCCUPIED)
    box, other = box_around(person), Box("couch", 0, 0, 160, 120)
    mask = dynamic_class_mask([box, other], view.levels[0].depth_m, DynamicClassConfig())
    recall, precision = recall_and_precision(mask, person)
    assert recall > 0.95
    assert precision > 0.6  # The sofa is within reach.
    assert not dynamic_class_mask([other], view.levels[0].depth_m, DynamicClassConfig()).any()


def test_box_without_depth_is_masked_whole_and_one_outside_is_ignored() -> None:
    boxes = [Box("dog", 2, 3, 6, 8), Box("cat", -20, -20, -5, -5)]
    mask = dynamic_class_mask(boxes, np.zeros((12, 16), np.float32), DynamicClassConfig())
    assert mask[3:8, 2:6].all()
    assert np.count_nonzero(mask) == 20


@pytest.mark.parametrize("wrong", [{"min_m": -1.0}, {"gone_frames": 0}, {"rim_px": -1}])
def test_impossible_settings_are_rejected(wrong: dict) -> None:
    with pytest.raises(ConfigError):
        MotionSegmentationConfig(**wrong)


# --- in the odometry ------------------------------------------------------------------------------
EACH_FRAME = KeyframeConfig(min_frames=1, max_frames=1, still_motion=0.0)  # Needs a keyframe.


def track(frames: Iterable[RgbdFrame]) -> list[TrackingResult]:
    odometry = Odometry(OdometryConfig(keyframes=KeyframeConfig(mapping_only_ratio=2.0)))
    return [odometry.process(frame) for frame in frames]


def test_odometry_does_not_track_against_the_walking_person(walk: PersonWalk) -> None:
    config = OdometryConfig(moving=CONFIG, keyframes=EACH_FRAME)
    odometry, keyframes = Odometry(config), []
    for k in range(56, 84, 2):
        frame = walk.frame(k)
        if k in (80, 82):  # The last frames against their keyframes.
            before = Odometry(config)
            before.restore(odometry.snapshot())
            before.process(frame, may_map=False)
            ignore_mask = before.snapshot()["keyframe"]["left_out"]
            assert recall_and_precision(ignore_mask, walk.person(keyframes[-1]))[0] > 0.5
        result = odometry.process(frame, may_map=k in (56, 80))
        if result.keyframe is not None:
            keyframes.append(k)
    assert keyframes == [56, 80]
    assert result.dynamic_mask is not None
    assert recall_and_precision(result.dynamic_mask, walk.person(k))[0] > 0.5


def test_odometry_does_not_track_against_a_detected_person(walk: PersonWalk) -> None:
    """The tracker has observed no motion yet; the mask also holds after a restart."""
    frame, person = walk.frame(OCCUPIED), walk.person(OCCUPIED)
    odometry = Odometry()
    keyframe = odometry.process(frame).reference
    assert keyframe is not None
    odometry.mask_dynamic_objects(keyframe, [Box("couch", 0, 0, 160, 120)])
    odometry.mask_dynamic_objects(keyframe + 1, [box_around(person)])
    assert odometry.snapshot()["keyframe"]["movable"] is None
    odometry.mask_dynamic_objects(keyframe, [box_around(person)])
    state = odometry.snapshot()
    assert recall_and_precision(state["keyframe"]["movable"], person)[0] > 0.95
    restored = Odometry()
    restored.restore(decode_state(encode_state(state)))
    for tracker in (odometry, restored):
        tracked = tracker.process(walk.frame(OCCUPIED + 6), may_map=False)
        error = se3.inverse(walk.T(OCCUPIED, OCCUPIED + 6)) @ tracked.T_odom_camera
        assert np.linalg.norm(error[:3, 3]) < 0.01


def box_around(mask: np.ndarray) -> Box:
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    return Box("person", columns[0] - 2, rows[0] - 2, columns[-1] + 3, rows[-1] + 3)


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_tracking_past_a_person_is_accurate_and_always_ok() -> None:
    """The values without segmentation are an ATE of 0.15 cm and 16 frames with status WEAK."""
    sequence = SyntheticSequence.named("person-noisy")
    results = track(sequence)
    T = np.array([r.T_odom_camera for r in results])
    truth = sequence.truth()
    errors = evaluate_trajectory(Trajectory(truth.stamps_s, T), truth)
    assert {r.status for r in results} == {TrackingStatus.OK}
    assert errors.ate_m.rmse < 0.0012
    recalls, precisions = zip(
        *(
            recall_and_precision(results[k].dynamic_mask, sequence.person(k))
            for k in range(40, 135)
            if results[k].dynamic_mask is not None
        ),
        strict=True,
    )
    assert np.mean(recalls) > 0.85
    assert np.mean(precisions) > 0.7


@pytest.mark.slow
@pytest.mark.timeout(600)
def test_static_kitchen_has_almost_no_dynamic_pixels(data: Path) -> None:
    kitchen = open_sequence(str(data / "tum" / "kitchen"))
    assert mean_masked(track(map(kitchen.__getitem__, range(300)))) < 0.01


@pytest.mark.slow
@pytest.mark.timeout(1200)
def test_static_flat_has_almost_no_dynamic_pixels() -> None:
    flat = open_sequence("synthetic:flat")
    assert mean_masked(track(map(flat.__getitem__, range(200)))) < 0.01


def mean_masked(results: list[TrackingResult]) -> float:
    masks = [r.dynamic_mask for r in results if r.dynamic_mask is not None]
    assert len(masks) > 0.9 * len(results)
    return float(np.mean([mask.mean() for mask in masks]))
