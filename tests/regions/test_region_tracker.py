"""Regions followed over keyframes, and when they are asked about."""

from dataclasses import replace

import numpy as np
import pytest

from ldo_service.conversions.frames import crops_from_request
from ldo_service.conversions.objects import label_request_to_message
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, codecs
from ldo_service.regions.foreground import Foreground
from ldo_service.regions.region import RegionLabelResult
from ldo_service.regions.region_proposals import RegionProposal
from ldo_service.regions.region_tracker import (
    MAX_VIEWS,
    RegionLabel,
    RegionTracker,
    RegionTrackerConfig,
)
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
    views_first=2, views=3, most_questions=2, patience=0, per_keyframe=9, at_once=9
)
RNG = np.random.default_rng(3)
COLOR = RNG.integers(0, 256, (*SHAPE, 3), np.uint8)


def thing(left: int = 60, top: int = 40, side: int = 30, **fields) -> RegionProposal:
    part = Foreground(top, left, np.ones((side, side), bool))
    box = np.array([left - 0.5, top - 0.5, left + side - 0.5, top + side - 0.5])
    return RegionProposal(box, part, **fields)


def piece(rows: int, **fields) -> RegionProposal:
    """The upper rows of the thing at 40, 40 with a side of 40."""
    part = Foreground(40, 40, np.ones((rows, 40), bool))
    return RegionProposal(np.array([39.5, 39.5, 79.5, 39.5 + rows]), part, **fields)


def moved(x_m: float = 0.0) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x_m
    return T


class Walk:
    """Keyframes one after the other, over a wall at 2 m."""

    def __init__(self, config: RegionTrackerConfig = CONFIG) -> None:
        self.regions = RegionTracker(config)
        self.T_map_keyframe: dict[int, np.ndarray] = {}

    def see(
        self, *found: RegionProposal, at_x_m: float = 0.0, color: np.ndarray = COLOR
    ) -> list[int]:
        keyframe = len(self.T_map_keyframe)
        self.T_map_keyframe[keyframe] = moved(at_x_m)
        depth_m = np.full(SHAPE, 2.0, np.float32)
        args = keyframe, found, color, depth_m, CAMERA, self.T_map_keyframe
        return [question.region.id for question in self.regions.observe_keyframe(*args).questions]

    def opinions(self, *found: RegionProposal) -> list[RegionLabel]:
        """What the next keyframe, from the same place, tells."""
        keyframe = len(self.T_map_keyframe)
        self.T_map_keyframe[keyframe] = moved()
        at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, self.T_map_keyframe
        return self.regions.observe_keyframe(keyframe, found, *at).opinions

    def answered(self, label: str, sure: float, region: int = 0) -> None:
        self.regions.answered(region, RegionLabelResult(label, sure))


def test_a_region_is_asked_about_when_it_was_seen_twice() -> None:
    walk = Walk()
    assert walk.see(thing()) == []
    assert walk.see(thing()) == [0]
    region = walk.regions.get(0)
    assert region is not None
    assert [view.keyframe for view in region.views] == [0, 1]
    assert (region.keyframe, region.box_px) == (1, (59.5, 39.5, 89.5, 69.5))


def test_it_is_the_same_where_the_camera_moved_and_another_one_elsewhere() -> None:
    """30 px at 2 m and f = 120 px are 0.5 m; the camera goes 0.5 m to the right."""
    walk = Walk()
    walk.see(thing(left=60))
    assert walk.see(thing(left=30), at_x_m=0.5) == [0]
    assert walk.see(thing(left=60), at_x_m=0.5) == []
    assert len(walk.regions) == 2


def test_it_is_asked_about_at_its_best_once_no_better_view_comes() -> None:
    walk = Walk(replace(CONFIG, patience=2))
    gray = np.full_like(COLOR, 128)
    gray[::7] = 140
    assert [walk.see(thing(), color=gray) for _ in range(2)] == [[], []]
    assert walk.see(thing(left=62)) == [], "far sharper: a better one may come"
    assert walk.see(thing(), color=gray) == []
    walk.T_map_keyframe[4] = moved()
    depth_m = np.full(SHAPE, 2.0, np.float32)
    out_of_sight = 4, [], COLOR, depth_m, CAMERA, walk.T_map_keyframe
    (question,) = walk.regions.observe_keyframe(*out_of_sight).questions
    assert (question.region.keyframe, question.region.box_px[0]) == (2, 61.5)
    assert question.candidate.part.column == 62


def test_questions_have_a_budget_and_what_has_most_to_show_goes_first() -> None:
    walk = Walk(replace(CONFIG, per_keyframe=0.5, at_once=1, most_questions=1))
    many = [thing(left=5, side=20), thing(left=40, side=40), thing(left=100, side=30)]
    asked = [walk.see(*many) for _ in range(8)]
    assert asked == [[], [1], [], [2], [], [0], [], []]


def test_a_name_is_less_sure_the_more_speaks_for_another() -> None:
    walk = Walk()
    walk.see(thing())
    walk.answered("oven", 0.6)
    region = walk.regions.get(0)
    assert region is not None
    assert walk.regions.name(region) == ("oven", 0.6)
    walk.answered("tv", 0.4)
    region = walk.regions.get(0)
    assert region is not None
    assert walk.regions.name(region) == ("oven", pytest.approx(0.6 * 0.36 / (0.36 + 0.16)))


def test_what_is_near_but_of_another_size_is_another() -> None:
    walk = Walk()
    walk.see(thing(left=60, side=30))
    walk.see(thing(left=66, top=46, side=17))
    assert len(walk.regions) == 2


def test_two_things_in_a_keyframe_are_never_one() -> None:
    walk = Walk()
    walk.see(thing(left=60), thing(left=64))
    assert len(walk.regions) == 2
    assert sorted(walk.see(thing(left=60), thing(left=64))) == [0, 1]


def test_a_correction_moves_regions_with_their_keyframes() -> None:
    walk = Walk()
    walk.see(thing())
    walk.T_map_keyframe[0] = moved(5.0)
    assert walk.see(thing(), at_x_m=5.0) == [0]


def test_it_is_asked_again_only_when_its_views_got_better_and_not_too_often() -> None:
    walk = Walk()
    gray = np.full_like(COLOR, 128)
    gray[::7] = 140
    assert [walk.see(thing(), color=gray) for _ in range(2)] == [[], [0]]
    assert walk.see(thing()) == [0], "far sharper"
    assert [walk.see(thing()) for _ in range(5)] == [[]] * 5, "asked twice already"


def test_a_confident_answer_settles_it_and_another_does_not() -> None:
    blurred = np.full_like(COLOR, 128)
    blurred[::7] = 140
    for confidence, more in ((0.59, [0]), (0.6, [])):
        walk = Walk()
        walk.see(thing(), color=blurred)
        walk.see(thing(), color=blurred)
        walk.answered("cup", confidence)
        assert walk.see(thing()) == more
    walk.answered("cup", 1.0, region=99)


def test_what_was_said_of_a_region_is_told_where_it_is_seen_again() -> None:
    walk = Walk()
    walk.see(thing())
    walk.see(thing())
    walk.answered("teapot", 0.5)
    walk.answered("kettle", 0.4)
    keyframe, depth_m = 2, np.full(SHAPE, 2.0, np.float32)
    walk.T_map_keyframe[keyframe] = moved()
    at = COLOR, depth_m, CAMERA, walk.T_map_keyframe
    asked_about, known, other = thing(), thing(left=62), thing(left=120)
    (opinion,) = walk.regions.observe_keyframe(keyframe, [asked_about], *at).opinions
    assert (opinion.of, opinion.label) == (asked_about, "teapot")
    assert opinion.sure == pytest.approx(0.5 * 0.25 / (0.25 + 0.16))
    seen = walk.regions.observe_keyframe(keyframe, [], *at, named=[known, other])
    assert [(one.of, one.label) for one in seen.opinions] == [(known, "teapot")]
    on_it, around_it = thing(left=70, top=50, side=10), thing(left=20, top=5, side=110)
    assert walk.regions.observe_keyframe(keyframe, [on_it], *at, named=[around_it]).opinions == []


def test_a_sure_name_is_told_where_its_region_is_seen_and_nothing_sets_it_apart() -> None:
    walk = Walk()
    walk.see(thing())
    walk.see(thing())
    T, depth_m = walk.T_map_keyframe, np.full(SHAPE, 2.0, np.float32)
    T[2], T[3] = moved(0.25), moved(4.0)

    def opinions(keyframe: int, *found: RegionProposal, depth_m: np.ndarray = depth_m):
        return walk.regions.observe_keyframe(keyframe, found, COLOR, depth_m, CAMERA, T).opinions

    walk.answered("teapot", 0.49)
    assert opinions(2) == [], "too little is known"
    walk.answered("teapot", 0.8)
    (told,) = opinions(2)
    assert (told.label, told.sure, told.of.number) == ("teapot", 0.8, None)
    # 0.25 m at 2 m and f = 120 px are 15 px
    np.testing.assert_allclose(told.of.box_px, thing(left=45).box_px, atol=4)
    # seen as a region of its own, it is told of that alone
    again = thing(left=45)
    assert [one.of for one in opinions(2, again)] == [again]
    # out of sight, or something else is there
    assert opinions(3) == []
    assert opinions(2, depth_m=depth_m + 1) == []
    # what boxes speak for too, and the more, is not told
    for _ in range(9):
        opinions(2, thing(left=45, label="kettle", score=0.55))
    assert opinions(2) == []


def test_a_region_of_a_few_pixels_is_not_looked_for() -> None:
    walk = Walk(replace(CONFIG, least_quality=0))
    assert [walk.see(thing(side=8)) for _ in range(2)] == [[], [0]]
    walk.answered("cup", 0.9)
    walk.T_map_keyframe[2] = moved()
    at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, walk.T_map_keyframe
    assert [
        one.label for one in walk.regions.observe_keyframe(2, [thing(side=8)], *at).opinions
    ] == ["cup"]
    assert walk.regions.observe_keyframe(2, [], *at).opinions == []


def test_what_the_detector_is_sure_of_is_not_asked_about() -> None:
    walk = Walk()
    walk.see(thing(label="vase", score=0.7))
    assert [walk.see(thing()) for _ in range(4)] == [[]] * 4
    region = walk.regions.get(0)
    assert region is not None
    assert region.seen == 5


def test_boxes_and_answers_vote_for_the_name_of_a_region() -> None:
    """Four answers' worth of 0.6 squared is 1.44, as nine boxes of 0.4 are."""
    walk = Walk()
    for _ in range(8):
        walk.see(thing(label="refrigerator", score=0.4))
    assert walk.regions.answered(0, RegionLabelResult("door", 0.6)) == "door"
    for _ in range(2):
        walk.see(thing(label="refrigerator", score=0.4))
    keyframe = len(walk.T_map_keyframe)
    walk.T_map_keyframe[keyframe] = moved()
    at = COLOR, np.full(SHAPE, 2.0, np.float32), CAMERA, walk.T_map_keyframe
    (opinion,) = walk.regions.observe_keyframe(keyframe, [thing()], *at).opinions
    assert (opinion.label, opinion.sure) == ("refrigerator", pytest.approx(0.4 * 1.6 / 3.04))
    assert walk.regions.answered(0, RegionLabelResult("cabinet", 0.5)) == "refrigerator"


def test_what_else_an_answer_takes_it_for_counts() -> None:
    """0.4 and 0.4 squared are 0.32, 0.5 squared is 0.25."""
    walk = Walk()
    walk.see(thing())
    assert (
        walk.regions.answered(0, RegionLabelResult("clock", 0.5, (("radiator", 0.4),))) == "clock"
    )
    assert (
        walk.regions.answered(0, RegionLabelResult("speaker", 0.45, (("radiator", 0.4),)))
        == "radiator"
    )


@pytest.mark.parametrize(
    ("kind", "rows", "told"),
    [
        ("apart", 20, ["cabinet", "cabinet"]),
        ("apart", 14, ["cabinet", "oven"]),  # 0.35 of 0.8 squared is less than 0.5 squared
        ("standing", 20, ["cabinet", "oven"]),
    ],
)
def test_what_was_said_of_a_region_counts_for_one_that_overlaps_it(
    kind: str, rows: int, told: list[str]
) -> None:
    """By how much it does; but for what stands on a thing. The upper half of a cabinet is told to
    be an oven, and half of 0.8 squared is more than 0.5 squared."""
    walk = Walk()
    whole, part = thing(left=40, side=40), piece(rows, kind=kind)
    for _ in range(2):
        walk.see(whole, part)
    walk.answered("cabinet", 0.8, region=0)
    walk.answered("oven", 0.5, region=1)
    assert [opinion.label for opinion in walk.opinions(whole, part)] == told


def test_a_box_that_comes_again_and_again_renames_nothing_small_within_it() -> None:
    walk = Walk()
    whole, part = thing(left=40, side=40, label="couch", score=0.55), piece(8)
    for _ in range(2):
        walk.see(whole, part)
    walk.answered("couch", 0.5, region=0)
    walk.answered("remote", 0.9, region=1)
    for _ in range(60):
        walk.see(whole, part)
    assert [opinion.label for opinion in walk.opinions(whole, part)] == ["couch", "remote"]
    region = walk.regions.get(0)
    assert region is not None
    ((_, total, _),) = region.votes
    assert total == CONFIG.answer_weight


def test_what_stood_on_a_thing_once_does_so_for_good() -> None:
    """Also when a larger sighting of it, which nothing set apart as standing, is kept."""
    walk = Walk()
    walk.see(thing(side=30, kind="standing"))
    walk.see(thing(side=31))
    region = walk.regions.get(0)
    assert region is not None
    assert (region.shape.candidate.kind, region.is_supported) == ("", True)


def test_few_names_are_carried_over_in_a_keyframe() -> None:
    walk = Walk(replace(CONFIG, most_carried=1))
    for _ in range(2):
        walk.see(thing(left=20), thing(left=90))
    for region in (0, 1):
        walk.answered("cup", 0.9, region=region)
    assert len(walk.opinions()) == 1


def test_a_view_that_shows_nothing_is_not_shown() -> None:
    walk = Walk()
    flat = np.full_like(COLOR, 128)
    assert [walk.see(thing(), color=flat) for _ in range(4)] == [[]] * 4
    assert walk.see(thing()) == []
    assert walk.see(thing()) == [0]


def test_the_surest_opinion_of_the_detector_is_kept() -> None:
    walk = Walk()
    walk.see(thing(label="vase", score=0.3))
    walk.see(thing(label="cup", score=0.5))
    walk.see(thing())
    region = walk.regions.get(0)
    assert region is not None
    assert (region.label, region.score) == ("cup", 0.5)


def test_the_region_not_seen_for_longest_is_forgotten() -> None:
    walk = Walk(replace(CONFIG, most=2))
    walk.see(thing(left=10), thing(left=60))
    walk.see(thing(left=10), thing(left=110))
    assert [walk.regions.get(region) is None for region in (0, 1, 2)] == [False, True, False]


def test_what_has_no_depth_is_left_out() -> None:
    regions = RegionTracker(CONFIG)
    nothing = np.zeros(SHAPE, np.float32)
    seen = regions.observe_keyframe(0, [thing()], COLOR, nothing, CAMERA, {0: moved()})
    assert (seen.questions, seen.opinions) == ([], [])
    assert len(regions) == 0


def test_a_state_is_plain_and_goes_on_where_it_was() -> None:
    walk = Walk()
    walk.see(thing(label="cup", score=0.5), thing(left=110))
    packed = decode_state(encode_state(walk.regions.pack()))
    successor = Walk()
    successor.regions = RegionTracker.unpack(packed, CONFIG)
    successor.T_map_keyframe = dict(walk.T_map_keyframe)
    assert successor.see(thing()) == walk.see(thing()) == [0]
    one, other = successor.regions.get(0), walk.regions.get(0)
    assert one is not None
    assert other is not None
    assert (one.views[0].jpeg, one.views[0].box_px) == (other.views[0].jpeg, other.views[0].box_px)
    assert successor.see(thing(top=80, left=20)) == []
    assert successor.regions.get(2) is not None, "ids go on"


def test_a_question_shows_its_views_the_best_first() -> None:
    walk = Walk()
    dull = np.full_like(COLOR, 128)
    dull[::7] = 140
    walk.see(thing(label="cup", score=0.5), color=dull)
    walk.see(thing())
    region = walk.regions.get(0)
    assert region is not None
    question = label_request_to_message(region, 77)
    assert (question.stamp_ns, question.region, question.keyframe) == (77, 0, 1)
    assert (question.label, question.score, question.box_px) == ("cup", 0.5, region.box_px)
    sharp, blurred = crops_from_request(question)
    assert sharp.shape == blurred.shape == (40, 40, 3)
    assert sharp.std() > 20 > blurred.std()


# --- how good a view is ---------------------------------------------------------------------------
def test_the_crop_shows_the_region_with_some_of_what_is_around_it() -> None:
    color = np.zeros((*SHAPE, 3), np.uint8)
    color[40:70, 60:90] = (250, 10, 10)
    depth_m = np.full(SHAPE, 2.0, np.float32)
    one = thing()
    view = region_view(4, color, depth_m, CAMERA, one.box_px, one.part, ViewConfig())
    assert (view.width, view.height, view.keyframe) == (40, 40, 4)
    crop = codecs.decode_color("jpeg", view.width, view.height, memoryview(view.jpeg))
    assert crop[19, 19, 0] > 200
    assert crop[1, 1].max() < 60


def test_views_cut_off_by_the_border_are_worse() -> None:
    config = ViewConfig()
    factors = [border_factor(thing(left=left).box_px, SHAPE, config) for left in (0, 1, 3, 60)]
    assert factors == pytest.approx([0.25, 0.5, 1.0, 1.0])


def test_blurred_views_are_worse() -> None:
    config = ViewConfig()
    flat = np.full((40, 40, 3), 128, np.uint8)
    assert sharpness_factor(flat, config) == 0
    assert sharpness_factor(COLOR[:40, :40], config) > 0.9


def test_a_surface_faced_is_better_than_one_edge_on() -> None:
    """A plane through (0, 0, 2) whose normal is turned by an angle about the vertical."""
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
def test_settings_that_cannot_be_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError):
        RegionTrackerConfig(**fields)


def test_a_request_has_room_for_all_views() -> None:
    assert MAX_VIEWS == MAX_CROPS
