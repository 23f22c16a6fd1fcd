"""RGB-D odometry: each frame's pose from direct alignment to the last keyframe.

    for frame in frames:
        tracked = odometry.track(frame)
        if tracked.wants_mapping and odometry.may_return:
            seen = odometry.seen_again(frame, tracked, *where_the_map_is)
            if seen and odometry.is_tied:
                tracked = odometry.return_to(seen, tracked)
        if tracked.wants_keyframe:
            odometry.make_keyframe(frame, tracked)
            measurements = odometry.window(tracked)  # of it, from keyframes before its reference
        elif tracked.wants_mapping:
            odometry.make_supporting(frame, tracked)
        elif tracked.may_begin:  # a new segment
            odometry.make_keyframe(frame, odometry.begin_segment(frame))

The caller decides whether there is room for a keyframe; without one, tracking goes on against the
last. Conventions: `ldo_service.geometry`.
"""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from ldo_service.detection.dynamic_classes import Box, MovableConfig
from ldo_service.errors import ConfigError
from ldo_service.geometry import RgbdFrame, se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import AlignConfig, Alignment, Appearance
from .features import FeatureConfig, ShapeConfig
from .keyframe_database import Place, Places, PlacesConfig, place_of, thumbnail_of
from .keyframes import Keyframe, KeyframeConfig, is_due, is_worth_mapping, movable_in
from .motion import Motion
from .motion_segmentation import MovingConfig, spread, watch
from .odometry_prior import Anchor, PriorConfig, Reading
from .pose_candidates import Candidate, CandidateConfig, Guesses
from .pyramid import Pyramid, PyramidConfig, pyramid_of
from .relocalization import (
    KeyframeReuse,
    RelocalisationConfig,
    Relocaliser,
    ReturnConfig,
    ReusedKeyframe,
    nearby,
)
from .state import Origin, State, packed, unpacked
from .submaps import Look, SegmentConfig, SubmapMeasurement
from .tracking_quality import History, JudgementConfig, Status, judge
from .tracking_result import Tracked, report
from .window import EarlierKeyframes, WindowConfig, measured_from

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class OdometryConfig:
    pyramid: PyramidConfig = field(default_factory=PyramidConfig)
    align: AlignConfig = field(default_factory=AlignConfig)
    features: FeatureConfig = field(default_factory=FeatureConfig)
    shape: ShapeConfig = field(default_factory=ShapeConfig)
    candidates: CandidateConfig = field(default_factory=CandidateConfig)
    keyframes: KeyframeConfig = field(default_factory=KeyframeConfig)
    window: WindowConfig = field(default_factory=WindowConfig)
    places: PlacesConfig = field(default_factory=PlacesConfig)
    relocalisation: RelocalisationConfig = field(default_factory=RelocalisationConfig)
    returning: ReturnConfig = field(default_factory=ReturnConfig)
    segments: SegmentConfig = field(default_factory=SegmentConfig)
    judgement: JudgementConfig = field(default_factory=JudgementConfig)
    moving: MovingConfig = field(default_factory=MovingConfig)
    movable: MovableConfig = field(default_factory=MovableConfig)
    prior: PriorConfig = field(default_factory=PriorConfig)
    large_motion: float = 0.05  # image widths per frame: 2 pixels of the coarsest level

    def __post_init__(self) -> None:
        if not self.large_motion > 0:
            raise ConfigError(f"large_motion={self.large_motion:g} must be positive.")


class Odometry:
    """Tracks one camera. Deterministic: equal frames give bitwise equal results."""

    def __init__(self, config: OdometryConfig | None = None) -> None:
        self.config = config or OdometryConfig()
        self._state = State()
        self._relocaliser = Relocaliser(
            self.config.pyramid,
            self.config.align,
            self.config.features,
            self.config.judgement,
            self.config.relocalisation,
        )
        self._returning = KeyframeReuse(
            self.config.pyramid,
            self.config.align,
            self.config.keyframes,
            self.config.judgement,
            self.config.returning,
        )
        self._guesses = Guesses(
            self.config.align,
            self.config.features,
            self.config.shape,
            self.config.candidates,
            self.config.large_motion,
        )
        self._viewed: tuple[RgbdFrame, Pyramid] | None = None  # the last frame, made ready
        self._prior: Reading | None = None  # of the last frame
        self._earlier = EarlierKeyframes(self.config.pyramid)

    def track(self, frame: RgbdFrame, prior: Reading | None = None) -> Tracked:
        """The pose of a frame. Never raises for what a frame shows: it may be blank.

        prior  where another odometry has the frame. It is one guess more, and while tracking is
               LOST the motion that it tells is added up. No status is better for it.
        """
        view, keyframe = self._view(frame), self._state.keyframe
        self._prior = prior
        if keyframe is None:
            return self._first(view)
        candidate = self._followed(keyframe, view, frame.stamp_ns)
        status = self._judged(candidate)
        if status is Status.WEAK and not self._relocaliser.is_familiar(view, self._state.trusted):
            status = Status.LOST
        if status is Status.LOST:
            found = self._found(view, self._places_when_lost(), is_lost=True)
            if found is None:
                return self._lost(frame, keyframe, candidate.alignment)
            (keyframe, candidate), status = found, Status.OK
            # noise is another elsewhere, and what has gone is of another keyframe
            origin = Origin.KNOWN if self.may_return else Origin.NEW
            self._state = replace(self._state, history=History(), suspicion=None, origin=origin)
        tracked = self._accepted(frame, keyframe, candidate, status)
        return self._joining(tracked, keyframe, view)

    def begin_segment(self, frame: RgbdFrame) -> Tracked:
        """The frame just tracked, LOST, as the first of a new segment, for `make_keyframe`.

        Odometry goes on where it was lost: its frame never jumps, and is wrong by what was missed.
        With a prior it goes on where that has the camera now.
        """
        segment = len(self._state.segments.roots)
        log.info("tracking begins segment %d with frame %d", segment, frame.index)
        carried = self._carried()
        T_odom_camera = self._state.motion.T_odom_camera if carried is None else carried
        return Tracked(
            T_odom_camera, np.eye(4), None, Status.OK, "first", True, True, segment=segment
        )

    def recognised(self, frame: RgbdFrame, places: Places) -> tuple[Keyframe, Alignment] | None:
        """The one of these places that the frame just tracked surely shows, and where from."""
        found = self._found(self._view(frame), places, is_lost=False)
        return None if found is None else (found[0], found[1].alignment)

    def make_keyframe(self, frame: RgbdFrame, tracked: Tracked, *, is_tied: bool = False) -> int:
        """Track against this frame, the one just tracked, from now on; its id as a keyframe.

        is_tied  it is measured from a known one too, so the camera may go back to these
        Raises ValueError for a LOST frame, whose pose is unknown.
        """
        if tracked.status is Status.LOST:
            raise ValueError(f"frame {frame.index} is LOST and cannot be a keyframe.")
        if tracked.method == "first":
            self._begin(frame, tracked)
        if tracked.join is not None:
            segments = self._state.segments.joined(tracked.segment, tracked.join.segment)
            self._state = replace(self._state, segments=segments)
        keyframe = self._keyframe_of(frame, tracked)
        place = self._place_of(keyframe)
        self._state = self._state.with_new(keyframe, place, self.config.places, is_tied=is_tied)
        return keyframe.id

    def seen_again(
        self,
        frame: RgbdFrame,
        tracked: Tracked,
        T_map_keyframe: Mapping[int, np.ndarray],
        T_map_camera: np.ndarray,
    ) -> ReusedKeyframe | None:
        """A known keyframe that shows what the frame just tracked does; None where none will do.

        T_map_keyframe  [4, 4] by id, where the map has them; T_map_camera [4, 4] likewise
        """
        joined = self._state.segments.are_merged
        known = [
            place
            for place in self._state.places.all
            if place.id != tracked.keyframe and joined(place.segment, tracked.segment)
        ]
        near = nearby(known, T_map_keyframe, T_map_camera, self.config.keyframes)
        return self._returning.find(self._view(frame), near, self._state.history)

    def return_to(self, seen: ReusedKeyframe, tracked: Tracked) -> Tracked:
        """Track against a known keyframe from now on; the frame just tracked, against that.

        Odometry goes on where it is: the keyframe is elsewhere in it now, and of its segment.
        """
        alignment = seen.candidate.alignment
        T_odom_keyframe = se3.orthonormalised(
            tracked.T_odom_camera @ se3.inverse(alignment.T_reference_camera)
        )
        here = {"T_odom_keyframe": T_odom_keyframe, "segment": tracked.segment}
        place, keyframe = replace(seen.place, **here), replace(seen.keyframe, **here)
        self._state = self._state.with_known(keyframe, place, tracked.T_odom_camera)
        method = seen.candidate.method
        return report(alignment, tracked.T_odom_camera, keyframe, Status.OK, method)

    def window(self, tracked: Tracked) -> list[RelativePose]:
        """The keyframe just made of a tracked frame, measured from others than its reference."""
        keyframe = self._state.keyframe
        if keyframe is None or tracked.keyframe is None:
            return []
        places = self._state.places.of(keyframe.segment, without={keyframe.id, tracked.keyframe})
        earlier = self._earlier.newest_first(places, self.config.window.reach)
        usual = Appearance(
            intensity_sigma=tracked.intensity_sigma, depth_noise_scale=tracked.depth_noise_scale
        )
        return measured_from(earlier, keyframe, usual, self.config.align, self.config.window)

    def leave_out(self, keyframe: int, boxes: Sequence[Box]) -> None:
        """What a detector found in a keyframe: things that move by themselves are not tracked
        against, as long as it is the one that frames are aligned to. Boxes in its own pixels."""
        current = self._state.keyframe
        if current is None or current.id != keyframe:
            return
        mask = movable_in(current.view, boxes, self.config.movable)
        if mask.any():
            self._state = replace(
                self._state,
                keyframe=replace(current, movable=mask),
                places=self._state.places.without(mask, keyframe),
            )

    def make_supporting(self, frame: RgbdFrame, tracked: Tracked) -> int:
        """Go on against the same keyframe; the id of this frame as one that is only mapped.

        The last of them is remembered: a camera that gets lost may still see what it showed.
        """
        supporting = self._keyframe_of(frame, tracked)
        self._state = replace(
            self._state,
            supporting=self._place_of(supporting),
            next_id=supporting.id + 1,
            T_odom_mapped=tracked.T_odom_camera,
        )
        return supporting.id

    @property
    def keyframe(self) -> int | None:
        """Id of the keyframe that the next frame is aligned to."""
        return None if self._state.keyframe is None else self._state.keyframe.id

    @property
    def may_return(self) -> bool:
        """Whether so many keyframes were made that known ones will do."""
        return 0 < self.config.returning.after <= self._state.next_id

    @property
    def is_tied(self) -> bool:
        """Whether the keyframe tracked against is a known one, or was measured from one."""
        return self._state.origin is not Origin.NEW

    def state(self) -> dict[str, Any]:
        """All that the next frames depend on, in arrays and plain values.

        Its `places`, `keyframe` and `supporting` are the same objects until they change.
        """
        return packed(self._state)

    def restore(self, state: dict[str, Any]) -> None:
        """Continue where `state` was taken: the next frames give bitwise equal results."""
        self._state = unpacked(state, self.config.pyramid)
        self._viewed = None
        self._earlier = EarlierKeyframes(self.config.pyramid)

    def _view(self, frame: RgbdFrame) -> Pyramid:
        if self._viewed is None or self._viewed[0] is not frame:
            self._viewed = (frame, pyramid_of(frame, self.config.pyramid))
        return self._viewed[1]

    def _first(self, view: Pyramid) -> Tracked:
        usable = self._is_usable(view)
        status, method = (Status.OK, "first") if usable else (Status.LOST, "none")
        return Tracked(np.eye(4), np.eye(4), None, status, method, usable, usable)

    def _is_usable(self, view: Pyramid) -> bool:
        """Whether others could be aligned to it."""
        measured = float(np.mean(view.levels[0].depth_m > 0))
        return measured >= self.config.judgement.min_paired

    def _begin(self, frame: RgbdFrame, tracked: Tracked) -> None:
        self._state = replace(
            self._state,
            motion=Motion(tracked.T_odom_camera, stamp_ns=frame.stamp_ns),
            status=Status.OK,
            trusted=thumbnail_of(self._view(frame)),
            history=History(),
            segments=self._state.segments.begun(),
            is_moving=None,
            suspicion=None,
            anchor=self._prior and Anchor(tracked.T_odom_camera, self._prior),
        )

    def _followed(self, keyframe: Keyframe, view: Pyramid, stamp_ns: int) -> Candidate:
        """Alignment from the predicted pose; from every other guess too, where that is not sure."""
        motion = self._state.motion
        T_keyframe_odom = se3.inverse(keyframe.T_odom_keyframe)
        resting = T_keyframe_odom @ motion.T_odom_camera
        predicted = self._guesses.from_motion(
            keyframe, view, T_keyframe_odom @ motion.predicted(stamp_ns)
        )
        is_sure = self._judged(predicted) is Status.OK
        if is_sure and not self._guesses.is_large_step(predicted, resting, view):
            return predicted
        T_odom_carried = self._carried()
        carried = None if T_odom_carried is None else T_keyframe_odom @ T_odom_carried
        return self._guesses.best_of_all(predicted, keyframe, view, resting, carried)

    def _carried(self) -> np.ndarray | None:
        """T_odom_camera [4, 4] of the last frame, by a prior's motion since the last OK one."""
        anchor, now = self._state.anchor, self._prior
        if anchor is None or now is None:
            return None
        return anchor.carried_to(now, self.config.prior)

    def _judged(self, candidate: Candidate) -> Status:
        state = self._state
        return judge(candidate, state.history, state.status, self.config.judgement)

    def _keyframe_of(self, frame: RgbdFrame, tracked: Tracked) -> Keyframe:
        view = self._view(frame)
        view = replace(view, depth_m=view.depth_m.copy())  # a camera may reuse its buffer
        return Keyframe(
            view,
            tracked.T_odom_camera,
            self._state.next_id,
            tracked.segment,
            has_moved=self._state.is_moving,
            left_out=tracked.is_moving,
        )

    def _place_of(self, keyframe: Keyframe) -> Place:
        return place_of(keyframe, self.config.features, self.config.places, self._state.history)

    def _places_when_lost(self) -> Places:
        """With the last frame mapped, which shows more of where the camera was than the last
        keyframe."""
        before = self._state
        if before.supporting is not None:
            places = before.places.added(before.supporting, self.config.places)
            self._state = replace(before, places=places, supporting=None)
        return self._state.places

    def _apart_from(self, segment: int) -> Places:
        """The places of segments that are not joined to one."""
        state = self._state
        joined = state.segments.are_merged
        return Places(tuple(p for p in state.places.all if not joined(p.segment, segment)))

    def _found(
        self, view: Pyramid, places: Places, *, is_lost: bool
    ) -> tuple[Keyframe, Candidate] | None:
        if not self._is_usable(view):
            return None
        state = self._state
        self._state = replace(state, searches=state.searches + 1)
        return self._relocaliser.find(view, places, state.searches, state.history, is_lost=is_lost)

    def _joining(self, tracked: Tracked, keyframe: Keyframe, view: Pyramid) -> Tracked:
        """Now and then, whether the view is seen from another segment too."""
        before, config = self._state.segments, self.config.segments
        if tracked.status is not Status.OK or not before.is_search_due(config):
            return tracked
        found = self._found(view, self._apart_from(keyframe.segment), is_lost=False)
        look = join = None
        if found is not None:
            there, alignment = found[0], found[1].alignment
            look = Look.at(there, alignment, tracked.segment, tracked.T_odom_camera)
            join = SubmapMeasurement.of(there, alignment)
        self._state = replace(self._state, segments=before.looked(look, config))
        if look is None or not before.is_confirmed_by(look, config):
            return tracked
        return replace(tracked, wants_keyframe=True, wants_mapping=True, join=join)

    def _lost(self, frame: RgbdFrame, keyframe: Keyframe, alignment: Alignment) -> Tracked:
        motion = self._state.motion.stopped()
        self._remember(frame, keyframe, motion, self._state.history, Status.LOST)
        self._state = replace(self._state, is_moving=None, suspicion=None)
        T_keyframe_camera = se3.inverse(keyframe.T_odom_keyframe) @ motion.T_odom_camera
        lost = report(
            replace(alignment, T_reference_camera=T_keyframe_camera, information=np.zeros((6, 6))),
            motion.T_odom_camera,
            keyframe,
            Status.LOST,
            "none",
        )
        may_begin = self._state.segments.should_start(frame.stamp_ns, self.config.segments)
        return replace(lost, may_begin=may_begin and self._is_usable(self._view(frame)))

    def _accepted(
        self, frame: RgbdFrame, keyframe: Keyframe, candidate: Candidate, status: Status
    ) -> Tracked:
        alignment, history, config = candidate.alignment, self._state.history, self.config
        T_odom_camera = se3.orthonormalised(keyframe.T_odom_keyframe @ alignment.T_reference_camera)
        motion = self._state.motion.moved_to(T_odom_camera, frame.stamp_ns)
        is_steady = status is Status.OK and self._state.status is Status.OK
        if status is Status.OK:
            history = history.extended(alignment, config.judgement)
            anchor = self._prior and Anchor(T_odom_camera, self._prior)
            trusted = thumbnail_of(self._view(frame))
            self._state = replace(self._state, trusted=trusted, anchor=anchor)
        self._remember(frame, keyframe, motion if is_steady else motion.stopped(), history, status)
        is_moving = None  # where a pose is unsure, surfaces contradict for that
        if status is Status.OK:
            is_moving = self._watched(keyframe, self._view(frame), alignment)
        frames = self._state.frames_since_keyframe
        is_known = self._state.origin is Origin.KNOWN
        if is_known:
            # what was put there since then does not move, and an old keyframe does for any time
            is_moving, frames = None, min(frames, config.keyframes.max_frames - 1)
            self._state = replace(self._state, is_moving=None)
        due = is_due(
            alignment.T_reference_camera,
            alignment.overlap,
            candidate.median_depth_m,
            frames,
            config.keyframes,
        )
        T_mapped_camera = se3.inverse(self._state.T_odom_mapped) @ T_odom_camera
        supports = not is_known and is_worth_mapping(
            T_mapped_camera, candidate.median_depth_m, config.keyframes
        )
        is_sure = status is Status.OK
        return report(
            alignment,
            T_odom_camera,
            keyframe,
            status,
            candidate.method,
            wants_keyframe=due and is_sure,
            wants_mapping=(due or supports) and is_sure,
            disagreement_rad=candidate.disagreement_rad,
            is_moving=is_moving,
        )

    def _watched(
        self, keyframe: Keyframe, view: Pyramid, alignment: Alignment
    ) -> np.ndarray | None:
        """What moves in a frame [H, W] bool; what has moved in its keyframe is left out of it."""
        config = self.config.moving
        if not config.is_on:
            return None
        seen = watch(
            view,
            keyframe.view,
            keyframe.has_moved,
            alignment.T_reference_camera,
            alignment.depth_noise_scale,
            self._state.suspicion,
            config,
            self.config.align.residuals.noise,
        )
        self._state = replace(self._state, is_moving=seen.is_moving, suspicion=seen.suspicion)
        if seen.is_much_news(keyframe.has_moved, config):
            left_out = spread(seen.has_moved, keyframe.view, config)
            renewed = replace(keyframe, has_moved=seen.has_moved, left_out=left_out)
            self._state = replace(self._state, keyframe=renewed)
        return spread(seen.is_moving, view, config)

    def _remember(
        self,
        frame: RgbdFrame,
        keyframe: Keyframe,
        motion: Motion,
        history: History,
        status: Status,
    ) -> None:
        before = self._state
        if status is not before.status:
            log.info("tracking %s, was %s; keyframe %d", status, before.status, keyframe.id)
        self._state = replace(
            before,
            keyframe=keyframe,
            motion=motion,
            history=history,
            status=status,
            frames_since_keyframe=before.frames_since_keyframe + 1,
            segments=before.segments.after(status is Status.LOST, frame.stamp_ns),
        )
