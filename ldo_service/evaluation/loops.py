"""Evaluation of loop closing against ground truth.

`ldo_service.geometry` describes the conventions of poses.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ldo_service.geometry import Camera, Trajectory, associate, se3
from ldo_service.geometry.sequence import Sequence as Frames

from .trajectory import ASSOCIATION_TOLERANCE_S

APART_FRAMES = 100
MIN_OVERLAP = 0.3
KEPT_ACROSS, ASKED_ACROSS = 160, 40  # Pixels per row of the stored depth and of the comparison.
# Two depths show one surface if they differ by less than SAME_M plus SAME_SHARE of the depth.
SAME_M, SAME_SHARE = 0.05, 0.03
LEFTOVER, LEAST = 5, 3  # Maximum and minimum keyframes of a subgraph that loops.json does not list.

PROTOCOL = """\
Loops: two keyframes overlap if each sees more than 30 % of the other's measured pixels, by the
source's depth (within 5 cm + 3 %) and true poses, and their viewing directions differ by at most 90
degrees. A pair of subgraphs is true if a keyframe of one overlaps a keyframe of the other, and
these two are more than 100 frames apart. Precision: fraction of the closures that connect a true
pair. Recall: of the subgraphs in a true pair with an older subgraph, the fraction that a closure
connects to such an older subgraph. Consecutive keyframes that are in no subgraph of loops.json form
subgraphs of at most five; groups of fewer than three are ignored. Errors: relative pose of each
closure, compared with the true relative pose. Time: duration of a search, divided by its number of
candidates."""


@dataclass(frozen=True, slots=True)
class ComparedPair:
    """Loop candidate: two compared subgraphs; each is a tuple of the ids of its keyframes."""

    newer: tuple[int, ...]
    older: tuple[int, ...]
    is_closure: bool  # False if the candidate was rejected.
    ms: float | None  # Duration of the comparison in milliseconds; None if not measured.


@dataclass(frozen=True, eq=False, slots=True)
class LoopClosed:
    """Loop closure between a new keyframe and an old one (`reference`).

    Attributes:
        keyframe: Id of the new keyframe.
        reference: Id of the old keyframe.
        T_reference_keyframe: Measured transform from the new to the old camera, [4, 4].
    """

    keyframe: int
    reference: int
    T_reference_keyframe: np.ndarray


@dataclass(frozen=True, slots=True)
class FoundLoops:
    """Loop candidates and loop closures of a run."""

    candidates: tuple[ComparedPair, ...]
    closures: tuple[LoopClosed, ...]


@dataclass(frozen=True, eq=False, slots=True)
class SeenKeyframe:
    """A keyframe with its true pose and its depth.

    Attributes:
        id: Id of the keyframe.
        frame: Index of its frame in the sequence.
        T_world_camera: True pose, [4, 4].
        camera: Intrinsics of the subsampled depth.
        depth_m: Subsampled depth, [H, W], meters; 0 where unknown.
    """

    id: int
    frame: int
    T_world_camera: np.ndarray
    camera: Camera
    depth_m: np.ndarray


@dataclass(frozen=True, slots=True)
class LoopErrors:
    """Scores of loop closing; a ratio is None if its denominator is 0.

    A subgraph is a group of keyframes. A pair of subgraphs is true if both show the same surfaces;
    the constant `PROTOCOL` gives the criteria.
    """

    closures: int  # Number of loop closures of the run.
    true_closures: int  # Closures that connect a true pair of subgraphs.
    queries: int  # Subgraphs that form a true pair with an older subgraph.
    closed_queries: int  # Queries with a closure to an older subgraph of a true pair.
    candidates: int  # Number of pairs of subgraphs that were compared.
    position_errors_m: tuple[float, ...]  # One per closure whose keyframes have true poses.
    rotation_errors_deg: tuple[float, ...]  # One per closure whose keyframes have true poses.
    ms: tuple[float, ...]  # Duration of the comparison of each candidate that was timed.
    retrieved_queries: int = 0  # Queries with an older subgraph of a true pair as a candidate.

    @property
    def precision(self) -> float | None:
        """Fraction of the loop closures that connect a true pair of subgraphs."""
        return self.true_closures / self.closures if self.closures else None

    @property
    def recall(self) -> float | None:
        """Fraction of the queries for which the run found a true loop closure.

        A query is a subgraph that forms true pairs with one or more older subgraphs. A true loop
        closure connects the query to one of these older subgraphs.
        """
        return self.closed_queries / self.queries if self.queries else None


def seen_keyframes(
    frames: Mapping[int, int], sequence: Frames, truth: Trajectory
) -> dict[int, SeenKeyframe]:
    """Return the keyframes that have a true pose within 20 ms of their stamp, by keyframe id.

    Args:
        frames: Frame index of each keyframe, by keyframe id.
        sequence: The sequence that the frame indices refer to.
        truth: True poses T_world_camera.
    """
    stamps_s = 1e-9 * sequence.stamps_ns[list(frames.values())]
    pairs = associate(stamps_s, truth.stamps_s, ASSOCIATION_TOLERANCE_S)
    ids = list(frames)
    return {
        ids[k]: _seen(ids[k], frames[ids[k]], sequence, truth.T_world_camera[at])
        for k, at in pairs.tolist()
    }


def _seen(id: int, index: int, sequence: Frames, T_world_camera: np.ndarray) -> SeenKeyframe:
    """Return a keyframe with its depth subsampled to every n-th pixel.

    This resolution is enough to measure overlap.
    """
    frame = sequence[index]
    step = max(1, frame.camera.width // KEPT_ACROSS)
    first, camera = step // 2, frame.camera
    depth_m = frame.depth_m[first::step, first::step].copy()
    small = Camera(
        depth_m.shape[1],
        depth_m.shape[0],
        camera.fx / step,
        camera.fy / step,
        (camera.cx - first) / step,
        (camera.cy - first) / step,
    )
    return SeenKeyframe(id, index, T_world_camera, small, depth_m)


def evaluate_loops(found: FoundLoops, keyframes: Mapping[int, SeenKeyframe]) -> LoopErrors:
    """Score loop closing as the constant `PROTOCOL` of this module describes.

    Args:
        found: Candidates and closures of a run.
        keyframes: Keyframes with a true pose, by id. All other keyframes are ignored.
    """
    subgraphs = _subgraphs(found, keyframes)
    index = {subgraph: number for number, subgraph in enumerate(subgraphs)}
    partners = _true_pairs(subgraphs, keyframes)
    compared = [(index.get(c.newer), index.get(c.older)) for c in found.candidates]
    pairs = [pair for pair, c in zip(compared, found.candidates, strict=True) if c.is_closure]
    right = {pair for pair in pairs if pair in partners}
    have_partner = {newer for newer, _ in partners}
    errors = [_error(c, keyframes) for c in found.closures if _are_known(c, keyframes)]
    return LoopErrors(
        closures=len(pairs),
        true_closures=sum(pair in partners for pair in pairs),
        queries=len(have_partner),
        closed_queries=len({newer for newer, _ in right}),
        candidates=len(found.candidates),
        position_errors_m=tuple(m for m, _ in errors),
        rotation_errors_deg=tuple(deg for _, deg in errors),
        ms=tuple(c.ms for c in found.candidates if c.ms is not None),
        retrieved_queries=len({newer for newer, _ in partners.intersection(compared)}),
    )


def overlap(new: SeenKeyframe, old: SeenKeyframe) -> float:
    """Return the fraction of pixels with depth in `new` whose surface also has depth in `old`.

    For speed, only about 40 pixels per image row are compared.
    """
    step = max(1, new.camera.width // ASKED_ACROSS)
    sampled = np.zeros(new.depth_m.shape, bool)
    sampled[step // 2 :: step, step // 2 :: step] = True
    v, u = np.nonzero(sampled & (new.depth_m > 0))
    if not len(v):
        return 0.0
    p_new = new.camera.points_at(u, v, new.depth_m[v, u])
    p_old = se3.transform(se3.inverse(old.T_world_camera) @ new.T_world_camera, p_new)
    p_old = p_old[p_old[:, 2] > 0]
    pixels = np.rint(old.camera.project(p_old)).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [old.camera.width, old.camera.height]), axis=1)
    there_m = old.depth_m[pixels[inside, 1], pixels[inside, 0]]
    gap_m = np.abs(p_old[inside, 2] - there_m)
    return float(np.sum((there_m > 0) & (gap_m < SAME_M + SAME_SHARE * there_m)) / len(v))


def _subgraphs(found: FoundLoops, keyframes: Mapping[int, SeenKeyframe]) -> list[tuple[int, ...]]:
    """Return all subgraphs of a run as tuples of keyframe ids, sorted.

    The candidates name the subgraphs that were compared. The remaining consecutive keyframes are
    grouped into subgraphs of at most five; groups of fewer than three are dropped.
    """
    named = {subgraph for c in found.candidates for subgraph in (c.newer, c.older)}
    taken = {keyframe for subgraph in named for keyframe in subgraph}
    left = [keyframe for keyframe in sorted(keyframes) if keyframe not in taken]
    groups: list[list[int]] = []
    for keyframe in left:
        if not groups or keyframe != groups[-1][-1] + 1 or len(groups[-1]) == LEFTOVER:
            groups.append([])
        groups[-1].append(keyframe)
    return sorted([*named, *(tuple(group) for group in groups if len(group) >= LEAST)])


def _true_pairs(
    subgraphs: Sequence[tuple[int, ...]], keyframes: Mapping[int, SeenKeyframe]
) -> set[tuple[int | None, int | None]]:
    """Return the true pairs (newer, older) as indices of subgraphs."""
    members = [[keyframes[k] for k in subgraph if k in keyframes] for subgraph in subgraphs]
    return {
        (newer, older)
        for newer in range(len(members))
        for older in range(newer)
        if any(_are_partners(a, b) for a in members[newer] for b in members[older])
    }


def _are_partners(new: SeenKeyframe, old: SeenKeyframe) -> bool:
    if abs(new.frame - old.frame) <= APART_FRAMES:
        return False
    looks_away = new.T_world_camera[:3, 2] @ old.T_world_camera[:3, 2] < 0
    if looks_away or overlap(new, old) <= MIN_OVERLAP:
        return False
    return overlap(old, new) > MIN_OVERLAP


def _are_known(closure: LoopClosed, keyframes: Mapping[int, SeenKeyframe]) -> bool:
    return closure.keyframe in keyframes and closure.reference in keyframes


def _error(closure: LoopClosed, keyframes: Mapping[int, SeenKeyframe]) -> tuple[float, float]:
    """Return the position error in m and the rotation error in degrees of a closure."""
    old, new = keyframes[closure.reference], keyframes[closure.keyframe]
    T_true = se3.inverse(old.T_world_camera) @ new.T_world_camera
    T = se3.inverse(T_true) @ closure.T_reference_keyframe
    return float(np.linalg.norm(T[:3, 3])), float(np.degrees(se3.rotation_angle(T)))
