"""Object landmarks: adding their observations to the pose graph, and removing lost landmarks."""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3

from .factors import BoxObservation, NoiseConfig, pack_observations, unpack_observations
from .label_fusion import Evidence, fuse_labels
from .loop_closures import Pair
from .pose_graph import PoseGraph

MAX_CLASSES = 256  # Maximum classes: C_max (LDO-SLAM paper, III.B).
BORDER_PX = 2.0  # A box closer to the border of the image counts as cut off.


def triangulate(origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the point [3] nearest to all rays, and the largest angle between two rays in rad.

    The point x minimizes sum_i |(I - d_i d_i^T) (x - o_i)|^2.

    Args:
        origins: Origins o_i of N >= 2 rays, [N, 3], meters.
        rays: Directions of any length, [N, 3]; d_i are the same directions with length 1.

    Raises:
        LinAlgError: All rays are parallel.
    """
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), (across @ origins[:, :, None])[..., 0].sum(axis=0))
    return point, float(np.arccos(np.clip((d @ d.T).min(), -1, 1)))


@dataclass(frozen=True, slots=True)
class ObjectLandmarkConfig:
    """Settings of object landmarks.

    Settings with `vague` in the name apply to labels whose entropy is above `vague_nats`.
    """

    lambda_sem: float = 0.5  # Weight of the observed labels (LDO-SLAM paper, III.C).
    # Weight of the similarity of landmarks that a keyframe shows together (LDO-SLAM paper, III.C).
    w_sem: float = 0.1
    # Limit of the entropy H. Above it, an observation has the weight exp(-2 H), and a landmark is
    # uncertain, so that it is removed earlier (LDO-SLAM paper, III.C).
    vague_nats: float = 0.5
    # Minimum number of observations at which a landmark is added to the graph (LDO-SLAM paper,
    # III.C).
    min_observations: int = 3
    # Minimum value of the largest angle between two rays to a new landmark: 5 degrees. At this
    # angle, an error of 12 px changes a depth of 2 m by 0.5 m (focal length 525 px).
    min_parallax_rad: float = 0.09
    # Maximum observations of a landmark in the graph. If there are more, the first and the newest
    # observations are kept, half of this number each.
    max_observations: int = 32
    # Consecutive misses after which a landmark is removed (LDO-SLAM paper, III.C).
    misses: int = 10
    vague_misses: int = 5  # Consecutive misses after which an uncertain landmark is removed.
    # Number of keyframes without an observation after which an uncertain landmark is removed.
    vague_keyframes: int = 20
    # Maximum landmarks; if there are more, the least recently observed ones are removed.
    max_landmarks: int = 1000
    # The schedule `adaptive` adds waiting observations to the graph once their total weight reaches
    # `due_weight`; `fixed` adds them at every keyframe with observations.
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    # Total weight of waiting observations at which `adaptive` adds them; an observation with low
    # entropy weighs 1.
    due_weight: float = 8.0
    # Number of waiting observations at which they are added, however small their weight.
    max_waiting: int = 256

    def __post_init__(self) -> None:
        counts = (
            self.max_observations,
            self.misses,
            self.vague_misses,
            self.max_landmarks,
            self.max_waiting,
        )
        if min(counts) < 1 or self.min_observations < 2:
            raise ConfigError(
                named(
                    self,
                    "min_observations",
                    "max_observations",
                    "misses",
                    "vague_misses",
                    "max_landmarks",
                    "max_waiting",
                )
                + ": min_observations must be at least 2, the other values must be at least 1."
            )
        if min(self.lambda_sem, self.due_weight, self.min_parallax_rad) <= 0 or self.w_sem < 0:
            raise ConfigError(
                named(self, "lambda_sem", "w_sem", "min_parallax_rad", "due_weight")
                + ": w_sem must not be negative, the other values must be positive."
            )


@dataclass(frozen=True, slots=True)
class LandmarkObservation:
    """Observation of an object in a keyframe, or a miss.

    In case of a miss, the object should be visible in the keyframe but was not detected.
    """

    keyframe: int
    landmark: int
    box_px: np.ndarray  # x0, y0, x1, y1 in pixels, [4].
    distribution: np.ndarray  # Class distribution [256]; its sum is one.
    entropy: float  # Entropy of `distribution`, nats.
    is_miss: bool
    camera: np.ndarray  # Width, height, fx, fy, cx, cy in pixels, [6].

    @property
    def is_whole(self) -> bool:
        """True if the box does not touch the image border, so that its center is reliable."""
        x0, y0, x1, y1 = self.box_px
        width, height = self.camera[:2]
        right, below = width - 1 - BORDER_PX, height - 1 - BORDER_PX
        return bool(min(x0, y0) > BORDER_PX and x1 < right and y1 < below)

    def pack(self) -> dict[str, Any]:
        """Return the fields as plain values.

        The label distribution is stored sparsely: most of its 256 probabilities are zero.
        """
        values = {name: getattr(self, name) for name in self.__slots__}
        labels = np.flatnonzero(self.distribution)
        return values | {"distribution": (labels, self.distribution[labels])}

    @staticmethod
    def unpack(packed: Mapping[str, Any]) -> "LandmarkObservation":
        """Return the observation that `pack` packed."""
        labels, weights = packed["distribution"]
        distribution = np.zeros(MAX_CLASSES)
        distribution[labels] = weights
        return LandmarkObservation(**{**packed, "distribution": distribution})


@dataclass(frozen=True, slots=True)
class Landmark:
    """State of a landmark without its position, which is a variable of the pose graph."""

    evidence: Evidence  # Sums of the observed class distributions.
    distribution: np.ndarray  # Fused class distribution, [256].
    observations: tuple[BoxObservation, ...] = ()
    misses: int = 0  # Consecutive misses since the last observation; see `LandmarkObservation`.
    last: int = -1  # Id of the last keyframe that observed the landmark; -1 for none.

    def knows(self, keyframe: int) -> bool:
        """Return whether the landmark already has an observation in a keyframe."""
        return keyframe == self.last or any(
            observation.keyframe == keyframe for observation in self.observations
        )

    @property
    def entropy(self) -> float:
        """Entropy of the fused distribution, nats."""
        p = self.distribution
        return float(-np.sum(p * np.log(np.where(p > 0, p, 1))))


class ObjectLandmarks:
    """Landmarks of the pose graph, with their observations and fused class distributions.

    Equal observations in the same order give equal landmarks. There are at most `max_landmarks`
    landmarks. Each has at most `max_observations` observations and needs 4 kB. In addition, all
    pairs of landmarks that are observed in the same keyframe are stored.
    """

    def __init__(self, config: ObjectLandmarkConfig, noise: NoiseConfig) -> None:
        """Create an empty set of landmarks."""
        self._config, self._noise = config, noise
        self.known: dict[int, Landmark] = {}
        self._waiting: list[LandmarkObservation] = []
        self._pairs: set[Pair] = set()  # Pairs of landmarks that a keyframe shows together.
        self._saved: dict[str, Any] = {}  # Entry `known` of the snapshot; empty if outdated.
        # Number of keyframes at which `needs_update` left observations waiting, for the metrics.
        self.skipped = 0

    def observe(self, seen: LandmarkObservation) -> None:
        """Store an observation for the next `update_graph`."""
        self._waiting.append(seen)

    def weight(self, entropy: float) -> float:
        """Return the weight 0..1 of an observation whose labels have this entropy, nats."""
        return float(np.exp(-2 * entropy)) if entropy > self._config.vague_nats else 1.0

    # --- into the graph ---------------------------------------------------------------------------
    def needs_update(self) -> bool:
        """Return whether `update_graph` must be called now.

        Call this once per keyframe: `skipped` counts the calls that leave observations waiting.
        """
        config = self._config
        if not self._waiting:
            return False
        weight = sum(self.weight(seen.entropy) for seen in self._waiting if not seen.is_miss)
        is_enough = weight >= config.due_weight or len(self._waiting) >= config.max_waiting
        if config.schedule == "fixed" or is_enough:
            return True
        self.skipped += 1
        return False

    def update_graph(self, graph: PoseGraph) -> None:
        """Add stored observations to the graph, fuse distributions, and remove lost landmarks."""
        waiting, self._waiting, self._saved = self._waiting, [], {}
        for seen in waiting:
            self._take(seen)
        self._pair(waiting)
        self._see(graph, {(seen.keyframe, seen.landmark) for seen in waiting if not seen.is_miss})
        self._fuse({seen.landmark for seen in waiting if not seen.is_miss})
        self._remove_lost(graph)

    def _take(self, seen: LandmarkObservation) -> None:
        old = self.known.get(seen.landmark)
        if seen.is_miss:
            if old is not None:
                self.known[seen.landmark] = replace(old, misses=old.misses + 1)
            return
        if old is not None and old.knows(seen.keyframe):
            return  # The observation was sent again after a restart.
        old = old or Landmark(Evidence.none(MAX_CLASSES), np.full(MAX_CLASSES, 1 / MAX_CLASSES))
        evidence = old.evidence.with_observed(seen.distribution, self.weight(seen.entropy))
        observations = (
            (*old.observations, self._observation(seen)) if seen.is_whole else old.observations
        )
        self.known[seen.landmark] = replace(
            old, evidence=evidence, observations=observations, misses=0, last=seen.keyframe
        )

    def _observation(self, seen: LandmarkObservation) -> BoxObservation:
        x0, y0, x1, y1 = seen.box_px
        share_px = self._noise.sigma_box_share * max(x1 - x0, y1 - y0)
        return BoxObservation(
            seen.keyframe,
            seen.landmark,
            np.array([x0 + x1, y0 + y1]) / 2,
            float(np.hypot(self._noise.sigma_box_px, share_px)),
            seen.camera[2:],
            self.weight(seen.entropy),
        )

    def _pair(self, waiting: Iterable[LandmarkObservation]) -> None:
        """Store the pairs of landmarks that are observed in the same keyframe."""
        shown: dict[int, set[int]] = {}
        for seen in waiting:
            if not seen.is_miss:
                shown.setdefault(seen.keyframe, set()).add(seen.landmark)
        for together in shown.values():
            self._pairs |= set(itertools.combinations(sorted(together), 2))

    def _see(self, graph: PoseGraph, waiting: set[Pair]) -> None:
        """Add observations to the graph, and new landmarks whose position can be triangulated.

        Args:
            graph: The pose graph.
            waiting: Keyframe and landmark of each new observation.
        """
        new, placed, gone = [], {}, []
        for k in sorted({landmark for _, landmark in waiting}):
            observations = [s for s in self.known[k].observations if s.keyframe in graph]
            kept = self._thinned(observations)
            self.known[k] = replace(self.known[k], observations=kept)
            if graph.has_landmark(k):
                left = {s.keyframe for s in kept}
                gone += [(s.keyframe, k) for s in observations if s.keyframe not in left]
                new += [s for s in kept if (s.keyframe, k) in waiting]
            elif (point := self._triangulated(kept, graph)) is not None:
                placed[k] = point
                new += kept
        if new:
            graph.add_observations(new, placed)
        graph.remove_observations(gone)

    def _thinned(self, observations: list[BoxObservation]) -> tuple[BoxObservation, ...]:
        """Return at most `max_observations` observations: half of them the first, half the newest.

        Keeping the first observations limits the drift of the landmark.
        """
        half = self._config.max_observations // 2
        excess = len(observations) - self._config.max_observations
        return tuple(
            observations if excess <= 0 else observations[:half] + observations[half + excess :]
        )

    def _triangulated(
        self, observations: Iterable[BoxObservation], graph: PoseGraph
    ) -> np.ndarray | None:
        """Triangulate the point [3] in the map where the rays through the box centers meet.

        Return None in four cases: there are too few observations; the parallax is too small; the
        point is less than 0.1 m in front of a camera; its projection is more than 3 sigma from the
        center of a box.
        """
        observations = list(observations)
        if len(observations) < self._config.min_observations:
            return None
        T_map = np.array([graph.pose(s.keyframe) for s in observations])
        fx, fy, cx, cy = np.array([s.intrinsics for s in observations]).T
        u, v = np.array([s.center_px for s in observations]).T
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(observations))], axis=1)
        try:
            point, parallax_rad = triangulate(
                T_map[:, :3, 3], (T_map[:, :3, :3] @ rays[..., None])[..., 0]
            )
        except np.linalg.LinAlgError:
            return None
        p = (se3.inverse(T_map) @ np.append(point, 1))[:, :3]
        if parallax_rad < self._config.min_parallax_rad or p[:, 2].min() <= 0.1:
            return None
        off_px = np.hypot(fx * p[:, 0] / p[:, 2] + cx - u, fy * p[:, 1] / p[:, 2] + cy - v)
        sigmas_px = np.array([s.sigma_px for s in observations])
        return point if np.all(off_px < 3 * sigmas_px) else None

    # --- labels -----------------------------------------------------------------------------------
    def _fuse(self, touched: set[int]) -> None:
        """Fuse the class distributions of the landmarks in `touched`, which have new observations.

        The distributions of other landmarks do not change.
        """
        pairs = [pair for pair in self._pairs if touched & set(pair)]
        near = touched | {k for pair in pairs for k in pair if k in self.known}
        p = fuse_labels(
            {k: self.known[k].evidence for k in near},
            pairs,
            lambda_sem=self._config.lambda_sem,
            w_sem=self._config.w_sem,
            start={k: self.known[k].distribution for k in near - touched},
            only=touched,
        )
        self.known |= {k: replace(self.known[k], distribution=p[k]) for k in touched}

    # --- removal ----------------------------------------------------------------------------------
    def _remove_lost(self, graph: PoseGraph) -> None:
        """Remove lost landmarks with their observations.

        The landmarks are not marginalized. Marginalization would leave a dense factor between all
        keyframes that observed the landmark. This factor would take much time for little
        information, and it would be linearized at the current poses.
        """
        newest = graph.newest or 0
        gone = [k for k, landmark in self.known.items() if self._should_remove(landmark, newest)]
        by_age = sorted(self.known.keys() - set(gone), key=lambda k: (self.known[k].last, k))
        gone += by_age[: max(0, len(by_age) - self._config.max_landmarks)]
        for k in gone:
            graph.remove_observations((s.keyframe, k) for s in self.known.pop(k).observations)
        self._pairs = {pair for pair in self._pairs if set(pair) <= self.known.keys()}

    def _should_remove(self, landmark: Landmark, newest: int) -> bool:
        config = self._config
        if landmark.misses >= config.misses:
            return True
        is_vague = landmark.entropy > config.vague_nats
        is_past = newest - landmark.last > config.vague_keyframes
        return is_vague and (landmark.misses >= config.vague_misses or is_past)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return the landmarks (`known`), the stored observations and the counter `skipped`.

        Snapshots between two calls of `update_graph` share one object `known`.
        """
        self._saved = self._saved or self._packed()
        waiting = [seen.pack() for seen in self._waiting]
        return {"known": self._saved, "waiting": waiting, "skipped": self.skipped}

    def _packed(self) -> dict[str, Any]:
        known = list(self.known.values())
        return {
            "ids": list(self.known),
            "weights": [float(one.evidence.weight) for one in known],
            "log_sums": np.array([one.evidence.log_sum for one in known]).reshape(-1, MAX_CLASSES),
            "distributions": np.array([one.distribution for one in known]).reshape(-1, MAX_CLASSES),
            "misses": [(one.misses, one.last) for one in known],
            "sights": pack_observations(s for one in known for s in one.observations),
            "pairs": sorted(self._pairs),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Continue from a snapshot."""
        packed = state["known"]
        observations: dict[int, list[BoxObservation]] = {}
        for observation in unpack_observations(packed["sights"]):
            observations.setdefault(observation.landmark, []).append(observation)
        columns = (packed[n] for n in ("ids", "weights", "log_sums", "distributions", "misses"))
        self.known = {
            k: Landmark(Evidence(weight, log_sum), p, tuple(observations.get(k, ())), *misses)
            for k, weight, log_sum, p, misses in zip(*columns, strict=True)
        }
        self._pairs = {(i, j) for i, j in packed["pairs"]}
        self._waiting = [LandmarkObservation.unpack(values) for values in state["waiting"]]
        self.skipped = state["skipped"]
