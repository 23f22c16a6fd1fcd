"""Region tracks over keyframes and their label requests."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.conversions.frames import crops_from_request
from ldo_service.conversions.objects import label_request_to_message
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, codecs
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import RegionLabel, RegionLabelResult
from ldo_service.regions.region_proposals import RegionProposal
from ldo_service.regions.region_tracker import RegionTracker
from ldo_service.regions.region_tracker_config import MAX_VIEWS, RegionTrackerConfig
from ldo_service.regions.region_views import (
    ViewConfig,
    border_factor,
    facing_factor,
    region_view,
    sharpness_factor,
)
from ldo_service.schemas.labels import MAX_CROPS
from ldo_service.storage.state_codec import decode_state, encode_state

CAMERA = Camera(160, 120, 120.0, 120.0, 80.0, 60.0)
SHAPE = 120, 160
CONFIG = RegionTrackerConfig(
    views_first=2, views=3, max_requests=2, patience=0, per_keyframe=9, at_once=9
)
RNG = np.random.default_rng(3)
COLOR = RNG.integers(0, 256, (*SHAPE, 3), np.uint8)


def proposal(left: int = 60, top: int = 40, side: int = 30, **fields) -> RegionProposal:
    part = Foreground(top, left, np.ones((side, side), bool))
    box = np.array([left - 0.5, top - 0.5, left + side - 0.5, top + side - 0.5])
    return RegionProposal(box, part, **fields)


def upper_rows(rows: int, **fields) -> RegionProposal:
    """Return the upper rows of the proposal at 40, 40 with a side of 40."""
    part = Foreground(40, 40, np.ones((rows, 40), bool))
    return RegionProposal(np.array([39.5, 39.5, 79.5, 39.5 + rows]), part, **fields)


def pose_at(x_m: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


class KeyframeSequence:
    """Sequence of keyframes that show a wall at 2 m."""

    def __init__(self, config: RegionTrackerConfig = CONFIG) -> None:
        self.regions = RegionTracker(config)
        self.T_map_keyframe: dict[int, np.ndarray] = {}

    def observe(
        self, *found: RegionProposal, at_x_m: float = 0.0, color: np.ndarray = COLOR
    ) -> list[int]:
        keyframe = len(self.T_map_keyframe)
        self.T_map_keyframe[keyframe] = pose_at(at_x_m)
        depth_m = np.full(SHAPE, 2.0, np.float32)
        args = keyframe, found, color, depth_m, CAMERA, self.T_map_keyframe
        return [request.region.id for request in self.regions.observe_keyframe(*args).questions]

    def next_labels(self, *found: RegionProposal) -> list[RegionLabel]:
        """Return the region labels of the next keyframe, from the same pose."""
        keyframe = len(self.T_map_keyframe)
        self.T_map_keyframe[keyframe] = pose_at()
        at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, self.T_map_keyframe
        return self.regions.observe_keyframe(keyframe, found, *at).region_labels

    def add_label_result(self, label: str, confidence: float, region: int = 0) -> None:
        self.regions.answered(region, RegionLabelResult(label, confidence))


def test_label_is_requested_at_the_second_observation() -> None:
    sequence = KeyframeSequence()
    assert sequence.observe(proposal()) == []
    assert sequence.observe(proposal()) == [0]
    region = sequence.regions.get(0)
    assert region is not None
    assert [view.keyframe for view in region.views] == [0, 1]
    assert (region.keyframe, region.box_px) == (1, (59.5, 39.5, 89.5, 69.5))


def test_region_is_matched_after_camera_motion_but_not_at_another_place() -> None:
    """30 px at 2 m and f = 120 px are 0.5 m; the camera goes 0.5 m to the right."""
    sequence = KeyframeSequence()
    sequence.observe(proposal(left=60))
    assert sequence.observe(proposal(left=30), at_x_m=0.5) == [0]
    assert sequence.observe(proposal(left=60), at_x_m=0.5) == []
    assert len(sequence.regions) == 2


def test_best_view_is_requested_when_no_better_one_follows() -> None:
    sequence = KeyframeSequence(replace(CONFIG, patience=2))
    gray = np.full_like(COLOR, 128)
    gray[::7] = 140
    assert [sequence.observe(proposal(), color=gray) for _ in range(2)] == [[], []]
    assert sequence.observe(proposal(left=62)) == [], "much sharper: a better view may follow"
    assert sequence.observe(proposal(), color=gray) == []
    sequence.T_map_keyframe[4] = pose_at()
    depth_m = np.full(SHAPE, 2.0, np.float32)
    out_of_sight = 4, [], COLOR, depth_m, CAMERA, sequence.T_map_keyframe
    (request,) = sequence.regions.observe_keyframe(*out_of_sight).questions
    assert (request.region.keyframe, request.region.box_px[0]) == (2, 61.5)
    assert request.candidate.part.column == 62


def test_requests_are_limited_and_sorted_by_size() -> None:
    sequence = KeyframeSequence(replace(CONFIG, per_keyframe=0.5, at_once=1, max_requests=1))
    many = [proposal(left=5, side=20), proposal(left=40, side=40), proposal(left=100, side=30)]
    requests = [sequence.observe(*many) for _ in range(8)]
    assert requests == [[], [1], [], [2], [], [0], [], []]


def test_votes_for_another_label_reduce_confidence() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal())
    sequence.add_label_result("oven", 0.6)
    region = sequence.regions.get(0)
    assert region is not None
    assert sequence.regions.name(region) == ("oven", 0.6)
    sequence.add_label_result("tv", 0.4)
    region = sequence.regions.get(0)
    assert region is not None
    assert sequence.regions.name(region) == ("oven", pytest.approx(0.6 * 0.36 / (0.36 + 0.16)))


def test_nearby_region_of_another_size_is_a_new_track() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal(left=60, side=30))
    sequence.observe(proposal(left=66, top=46, side=17))
    assert len(sequence.regions) == 2


def test_proposals_of_one_keyframe_are_separate_tracks() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal(left=60), proposal(left=64))
    assert len(sequence.regions) == 2
    assert sorted(sequence.observe(proposal(left=60), proposal(left=64))) == [0, 1]


def test_regions_move_with_corrected_keyframes() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal())
    sequence.T_map_keyframe[0] = pose_at(5.0)
    assert sequence.observe(proposal(), at_x_m=5.0) == [0]


def test_request_is_repeated_only_for_better_views_up_to_the_limit() -> None:
    sequence = KeyframeSequence()
    gray = np.full_like(COLOR, 128)
    gray[::7] = 140
    assert [sequence.observe(proposal(), color=gray) for _ in range(2)] == [[], [0]]
    assert sequence.observe(proposal()) == [0], "much sharper"
    assert [sequence.observe(proposal()) for _ in range(5)] == [[]] * 5, "requested twice already"


def test_only_a_confident_label_result_ends_the_requests() -> None:
    blurred = np.full_like(COLOR, 128)
    blurred[::7] = 140
    for confidence, more in ((0.59, [0]), (0.6, [])):
        sequence = KeyframeSequence()
        sequence.observe(proposal(), color=blurred)
        sequence.observe(proposal(), color=blurred)
        sequence.add_label_result("cup", confidence)
        assert sequence.observe(proposal()) == more
    sequence.add_label_result("cup", 1.0, region=99)


def test_label_is_applied_when_its_region_is_observed_again() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal())
    sequence.observe(proposal())
    sequence.add_label_result("teapot", 0.5)
    sequence.add_label_result("kettle", 0.4)
    keyframe, depth_m = 2, np.full(SHAPE, 2.0, np.float32)
    sequence.T_map_keyframe[keyframe] = pose_at()
    at = COLOR, depth_m, CAMERA, sequence.T_map_keyframe
    requested, known, other = proposal(), proposal(left=62), proposal(left=120)
    (region_label,) = sequence.regions.observe_keyframe(keyframe, [requested], *at).region_labels
    assert (region_label.of, region_label.label) == (requested, "teapot")
    assert region_label.sure == pytest.approx(0.5 * 0.25 / (0.25 + 0.16))
    observed = sequence.regions.observe_keyframe(keyframe, [], *at, named=[known, other])
    assert [(one.of, one.label) for one in observed.region_labels] == [(known, "teapot")]
    inside, surrounding = proposal(left=70, top=50, side=10), proposal(left=20, top=5, side=110)
    assert (
        sequence.regions.observe_keyframe(
            keyframe, [inside], *at, named=[surrounding]
        ).region_labels
        == []
    )


def test_confident_label_is_propagated_without_a_proposal_of_its_region() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal())
    sequence.observe(proposal())
    T, depth_m = sequence.T_map_keyframe, np.full(SHAPE, 2.0, np.float32)
    T[2], T[3] = pose_at(0.25), pose_at(4.0)

    def labels_at(keyframe: int, *found: RegionProposal, depth_m: np.ndarray = depth_m):
        return sequence.regions.observe_keyframe(
            keyframe, found, COLOR, depth_m, CAMERA, T
        ).region_labels

    sequence.add_label_result("teapot", 0.49)
    assert labels_at(2) == [], "the confidence is too low"
    sequence.add_label_result("teapot", 0.8)
    (region_label,) = labels_at(2)
    assert (region_label.label, region_label.sure, region_label.of.number) == ("teapot", 0.8, None)
    # 0.25 m at 2 m and f = 120 px are 15 px
    np.testing.assert_allclose(region_label.of.box_px, proposal(left=45).box_px, atol=4)
    # A proposal of the region gets the label instead.
    again = proposal(left=45)
    assert [one.of for one in labels_at(2, again)] == [again]
    # The region is out of view, or another surface is at its place.
    assert labels_at(3) == []
    assert labels_at(2, depth_m=depth_m + 1) == []
    # Detections with more votes for another label suppress it.
    for _ in range(9):
        labels_at(2, proposal(left=45, label="kettle", score=0.55))
    assert labels_at(2) == []


def test_small_region_is_not_propagated() -> None:
    sequence = KeyframeSequence(replace(CONFIG, min_quality=0))
    assert [sequence.observe(proposal(side=8)) for _ in range(2)] == [[], [0]]
    sequence.add_label_result("cup", 0.9)
    sequence.T_map_keyframe[2] = pose_at()
    at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, sequence.T_map_keyframe
    assert [
        one.label
        for one in sequence.regions.observe_keyframe(2, [proposal(side=8)], *at).region_labels
    ] == ["cup"]
    assert sequence.regions.observe_keyframe(2, [], *at).region_labels == []


def test_confident_detection_is_not_requested() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal(label="vase", score=0.7))
    assert [sequence.observe(proposal()) for _ in range(4)] == [[]] * 4
    region = sequence.regions.get(0)
    assert region is not None
    assert region.seen == 5


def test_detections_and_label_results_vote_for_the_label() -> None:
    """A label result of 0.6 counts as 4 * 0.6**2 = 1.44, like nine boxes of 0.4."""
    sequence = KeyframeSequence()
    for _ in range(8):
        sequence.observe(proposal(label="refrigerator", score=0.4))
    assert sequence.regions.answered(0, RegionLabelResult("door", 0.6)) == "door"
    for _ in range(2):
        sequence.observe(proposal(label="refrigerator", score=0.4))
    keyframe = len(sequence.T_map_keyframe)
    sequence.T_map_keyframe[keyframe] = pose_at()
    at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, sequence.T_map_keyframe
    (region_label,) = sequence.regions.observe_keyframe(keyframe, [proposal()], *at).region_labels
    assert (region_label.label, region_label.sure) == (
        "refrigerator",
        pytest.approx(0.4 * 1.6 / 3.04),
    )
    assert sequence.regions.answered(0, RegionLabelResult("cabinet", 0.5)) == "refrigerator"


def test_alternatives_of_label_results_are_counted() -> None:
    """Two alternatives of 0.4 have 2 * 0.4**2 = 0.32, one label of 0.5 has 0.25."""
    sequence = KeyframeSequence()
    sequence.observe(proposal())
    assert (
        sequence.regions.answered(0, RegionLabelResult("clock", 0.5, (("radiator", 0.4),)))
        == "clock"
    )
    assert (
        sequence.regions.answered(0, RegionLabelResult("speaker", 0.45, (("radiator", 0.4),)))
        == "radiator"
    )


@pytest.mark.parametrize(
    ("kind", "rows", "expected"),
    [
        ("apart", 20, ["cabinet", "cabinet"]),
        ("apart", 14, ["cabinet", "oven"]),  # 0.35 * 0.8**2 is less than 0.5**2.
        ("standing", 20, ["cabinet", "oven"]),
    ],
)
def test_votes_are_shared_with_overlapping_regions(
    kind: str, rows: int, expected: list[str]
) -> None:
    """Votes are weighted by the overlap, except for standing regions.

    The upper half of a cabinet is labelled oven. The vote for oven, 0.5**2, is less than the vote
    for cabinet weighted by the overlap, 0.5 * 0.8**2.
    """
    sequence = KeyframeSequence()
    whole, part = proposal(left=40, side=40), upper_rows(rows, kind=kind)
    for _ in range(2):
        sequence.observe(whole, part)
    sequence.add_label_result("cabinet", 0.8, region=0)
    sequence.add_label_result("oven", 0.5, region=1)
    assert [region_label.label for region_label in sequence.next_labels(whole, part)] == expected


def test_repeated_box_does_not_relabel_a_small_region_inside() -> None:
    sequence = KeyframeSequence()
    whole, part = proposal(left=40, side=40, label="couch", score=0.55), upper_rows(8)
    for _ in range(2):
        sequence.observe(whole, part)
    sequence.add_label_result("couch", 0.5, region=0)
    sequence.add_label_result("remote", 0.9, region=1)
    for _ in range(60):
        sequence.observe(whole, part)
    assert [region_label.label for region_label in sequence.next_labels(whole, part)] == [
        "couch",
        "remote",
    ]
    region = sequence.regions.get(0)
    assert region is not None
    ((_, total, _),) = region.votes
    assert total == CONFIG.answer_weight


def test_supported_flag_of_a_region_persists() -> None:
    """The flag stays when a larger observation without it replaces the shape."""
    sequence = KeyframeSequence()
    sequence.observe(proposal(side=30, kind="standing"))
    sequence.observe(proposal(side=31))
    region = sequence.regions.get(0)
    assert region is not None
    assert (region.shape.candidate.kind, region.is_supported) == ("", True)


def test_propagated_labels_per_keyframe_are_limited() -> None:
    sequence = KeyframeSequence(replace(CONFIG, max_propagated=1))
    for _ in range(2):
        sequence.observe(proposal(left=20), proposal(left=90))
    for region in (0, 1):
        sequence.add_label_result("cup", 0.9, region=region)
    assert len(sequence.next_labels()) == 1


def test_view_without_contrast_is_not_requested() -> None:
    sequence = KeyframeSequence()
    uniform = np.full_like(COLOR, 128)
    assert [sequence.observe(proposal(), color=uniform) for _ in range(4)] == [[]] * 4
    assert sequence.observe(proposal()) == []
    assert sequence.observe(proposal()) == [0]


def test_most_confident_detection_is_kept() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal(label="vase", score=0.3))
    sequence.observe(proposal(label="cup", score=0.5))
    sequence.observe(proposal())
    region = sequence.regions.get(0)
    assert region is not None
    assert (region.label, region.score) == ("cup", 0.5)


def test_least_recently_observed_region_is_removed() -> None:
    sequence = KeyframeSequence(replace(CONFIG, most=2))
    sequence.observe(proposal(left=10), proposal(left=60))
    sequence.observe(proposal(left=10), proposal(left=110))
    assert [sequence.regions.get(region) is None for region in (0, 1, 2)] == [False, True, False]


def test_proposal_without_depth_is_ignored() -> None:
    regions = RegionTracker(CONFIG)
    nothing = np.zeros(SHAPE, np.float32)
    observed = regions.observe_keyframe(0, [proposal()], COLOR, nothing, CAMERA, {0: pose_at()})
    assert (observed.questions, observed.region_labels) == ([], [])
    assert len(regions) == 0


def test_restored_tracker_continues_equal() -> None:
    sequence = KeyframeSequence()
    sequence.observe(proposal(label="cup", score=0.5), proposal(left=110))
    packed = decode_state(encode_state(sequence.regions.pack()))
    restored = KeyframeSequence()
    restored.regions = RegionTracker.unpack(packed, CONFIG)
    restored.T_map_keyframe = dict(sequence.T_map_keyframe)
    assert restored.observe(proposal()) == sequence.observe(proposal()) == [0]
    one, other = restored.regions.get(0), sequence.regions.get(0)
    assert one is not None
    assert other is not None
    assert (one.views[0].jpeg, one.views[0].box_px) == (other.views[0].jpeg, other.views[0].box_px)
    assert restored.observe(proposal(top=80, left=20)) == []
    assert restored.regions.get(2) is not None, "ids continue"


def test_label_request_sorts_views_by_quality() -> None:
    sequence = KeyframeSequence()
    low_contrast = np.full_like(COLOR, 128)
    low_contrast[::7] = 140
    sequence.observe(proposal(label="cup", score=0.5), color=low_contrast)
    sequence.observe(proposal())
    region = sequence.regions.get(0)
    assert region is not None
    request = label_request_to_message(region, 77)
    assert (request.stamp_ns, request.region, request.keyframe) == (77, 0, 1)
    assert (request.label, request.score, request.box_px) == ("cup", 0.5, region.box_px)
    sharp, blurred = crops_from_request(request)
    assert sharp.shape == blurred.shape == (40, 40, 3)
    assert sharp.std() > 20 > blurred.std()


# --- view quality ---------------------------------------------------------------------------------
def test_crop_includes_a_margin_around_the_region() -> None:
    color = np.zeros((*SHAPE, 3), np.uint8)
    color[40:70, 60:90] = (250, 10, 10)
    depth_m = np.full(SHAPE, 2.0, np.float32)
    one = proposal()
    view = region_view(4, color, depth_m, CAMERA, one.box_px, one.part, ViewConfig())
    assert view is not None
    assert (view.width, view.height, view.keyframe) == (40, 40, 4)
    crop = codecs.decode_color("jpeg", view.width, view.height, memoryview(view.jpeg))
    assert crop[19, 19, 0] > 200
    assert crop[1, 1].max() < 60


def test_view_below_the_minimum_quality_is_not_made() -> None:
    depth_m, one = np.full(SHAPE, 2.0, np.float32), proposal()
    args = 4, COLOR, depth_m, CAMERA, one.box_px, one.part, ViewConfig()
    view = region_view(*args)
    assert view is not None
    same = region_view(*args, view.quality)
    assert same is not None
    assert (same.quality, same.jpeg) == (view.quality, view.jpeg)
    assert region_view(*args, float(np.nextafter(view.quality, 1))) is None


def test_crop_of_a_view_that_is_not_stored_is_not_encoded(monkeypatch: pytest.MonkeyPatch) -> None:
    encoded: list[np.ndarray] = []
    encode = codecs.encode_jpeg
    monkeypatch.setattr(codecs, "encode_jpeg", lambda crop: encoded.append(crop) or encode(crop))
    sequence = KeyframeSequence()
    for _ in range(CONFIG.views + 2):  # The last two views are no better than the stored ones.
        sequence.observe(proposal())
    sequence.observe(proposal(side=34))
    region = sequence.regions.get(0)
    assert region is not None
    assert [view.keyframe for view in region.views] == [5, 0, 1]
    assert len(encoded) == CONFIG.views + 1


def test_views_clipped_by_the_image_have_lower_quality() -> None:
    config = ViewConfig()
    factors = [border_factor(proposal(left=left).box_px, SHAPE, config) for left in (0, 1, 3, 60)]
    assert factors == pytest.approx([0.25, 0.5, 1.0, 1.0])


def test_blurred_views_have_lower_quality() -> None:
    config = ViewConfig()
    uniform = np.full((40, 40, 3), 128, np.uint8)
    assert sharpness_factor(uniform, config) == 0
    assert sharpness_factor(COLOR[:40, :40], config) > 0.9


def test_quality_decreases_with_viewing_angle() -> None:
    """A plane through (0, 0, 2) with its normal rotated about the vertical."""
    config, part = ViewConfig(), Foreground(58, 78, np.ones((5, 5), bool))
    u = (np.arange(160) - CAMERA.cx) / CAMERA.fx
    for angle in (0.0, 0.6, 1.2):
        depth_m = np.tile(2 / (1 + np.tan(angle) * u), (120, 1)).astype(np.float32)
        expected = 0.25 + 0.75 * np.cos(angle)
        assert facing_factor(depth_m, CAMERA, part, config) == pytest.approx(expected, abs=0.02)


@pytest.mark.parametrize(
    "fields",
    [
        {"views": 0},
        {"views": MAX_VIEWS + 1},
        {"views_first": 8},
        {"gain": 1.0},
        {"overlap": 0.0},
    ],
)
def test_invalid_settings_raise_config_error(fields: dict) -> None:
    with pytest.raises(ConfigError):
        RegionTrackerConfig(**fields)


def test_view_limit_equals_crop_limit_of_requests() -> None:
    assert MAX_VIEWS == MAX_CROPS
