"""Landmarks: from what keyframes show of objects to variables of the graph, and out again."""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3

from .factors import BoxObservation, NoiseConfig, pack_sights, unpack_sights
from .label_fusion import Evidence, fuse_labels
from .loop_closures import Pair
from .pose_graph import PoseGraph

MAX_CLASSES = 256  # C_max of the paper, III.B
BORDER_PX = 2.0  # a box so near to the border of the image is cut by it


def triangulate(origins: np.ndarray, rays: np.ndarray) -> tuple[np.ndarray, float]:
    """The point [3] nearest to all rays, and the widest angle in rad between two of them.

        min_x sum_i |(I - d_i d_i^T) (x - o_i)|^2

    origins [N, 3], in metres; rays [N, 3] of any length, N >= 2. Raises LinAlgError when all are
    parallel.
    """
    d = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    across = np.eye(3) - d[:, :, None] * d[:, None, :]
    point = np.linalg.solve(across.sum(axis=0), (across @ origins[:, :, None])[..., 0].sum(axis=0))
    return point, float(np.arccos(np.clip((d @ d.T).min(), -1, 1)))


@dataclass(frozen=True, slots=True)
class ObjectLandmarkConfig:
    lambda_sem: float = 0.5  # III.C
    w_sem: float = 0.1  # III.C
    vague_nats: float = 0.5  # III.C: above, what is observed weighs exp(-2 H), and leaves earlier
    least_sights: int = 3  # III.C
    least_parallax_rad: float = 0.09  # 5 deg: 12 px at 2 m and 525 px are 0.5 m in depth there
    most_sights: int = 32  # of a landmark in the graph: the first half of them stays
    misses: int = 10  # in a row, then it is gone (III.C)
    vague_misses: int = 5
    vague_keyframes: int = 20  # without a sight, then a vague one is gone
    most: int = 1000  # landmarks; of more, those that were not seen for longest leave
    # adaptive: the graph takes observations in once so much weight of them waits, a vague one
    # weighing less; fixed: at every keyframe that has some
    schedule: Literal["adaptive", "fixed"] = "adaptive"
    due_weight: float = 8.0
    most_waiting: int = 256  # observations, however little they weigh

    def __post_init__(self) -> None:
        counts = (self.most_sights, self.misses, self.vague_misses, self.most, self.most_waiting)
        if min(counts) < 1 or self.least_sights < 2:
            raise ConfigError(
                named(
                    self,
                    "least_sights",
                    "most_sights",
                    "misses",
                    "vague_misses",
                    "most",
                    "most_waiting",
                )
                + ": counts must be at least 1, least_sights at least 2."
            )
        if min(self.lambda_sem, self.due_weight, self.least_parallax_rad) <= 0 or self.w_sem < 0:
            raise ConfigError(
                named(self, "lambda_sem", "w_sem", "least_parallax_rad", "due_weight")
                + ": weights and angles must be positive."
            )


@dataclass(frozen=True, slots=True)
class LandmarkObservation:
    """An object in a keyframe, or missing there."""

    keyframe: int
    landmark: int
    box_px: np.ndarray  # [4] x0 y0 x1 y1
    distribution: np.ndarray  # [C], sums to one
    entropy: float  # nats
    is_miss: bool
    camera: np.ndarray  # [6] width height fx fy cx cy, px

    @property
    def is_whole(self) -> bool:
        """Not cut by the border of the image, which would move the centre of its box."""
        x0, y0, x1, y1 = self.box_px
        width, height = self.camera[:2]
        right, below = width - 1 - BORDER_PX, height - 1 - BORDER_PX
        return bool(min(x0, y0) > BORDER_PX and x1 < right and y1 < below)

    def pack(self) -> dict[str, Any]:
        """Of its distribution only what is not zero: a few of 256."""
        values = {name: getattr(self, name) for name in self.__slots__}
        labels = np.flatnonzero(self.distribution)
        return values | {"distribution": (labels, self.distribution[labels])}

    @staticmethod
    def unpack(packed: Mapping[str, Any]) -> "LandmarkObservation":
        labels, weights = packed["distribution"]
        distribution = np.zeros(MAX_CLASSES)
        distribution[labels] = weights
        return LandmarkObservation(**{**packed, "distribution": distribution})


@dataclass(frozen=True, slots=True)
class Landmark:
    """What is known of one beside its place."""

    evidence: Evidence
    distribution: np.ndarray  # [C]
    sights: tuple[BoxObservation, ...] = ()
    misses: int = 0  # in a row
    last: int = -1  # keyframe that saw it

    def knows(self, keyframe: int) -> bool:
        return keyframe == self.last or any(sight.keyframe == keyframe for sight in self.sights)

    @property
    def entropy(self) -> float:
        p = self.distribution
        return float(-np.sum(p * np.log(np.where(p > 0, p, 1))))


class ObjectLandmarks:
    """Deterministic; bounded by `most` landmarks, each 4 kB and its sights, and the pairs of them
    that a keyframe showed together."""

    def __init__(self, config: ObjectLandmarkConfig, noise: NoiseConfig) -> None:
        self._config, self._noise = config, noise
        self.known: dict[int, Landmark] = {}
        self._waiting: list[LandmarkObservation] = []
        self._pairs: set[Pair] = set()  # that a keyframe shows together
        self._saved: dict[str, Any] = {}  # what is known, until it changes
        self.skipped = 0  # keyframes at which the graph was left alone

    def observe(self, seen: LandmarkObservation) -> None:
        """To be taken in at the next `update_graph`."""
        self._waiting.append(seen)

    def weight(self, entropy: float) -> float:
        """Of what was observed with so much entropy, in nats."""
        return float(np.exp(-2 * entropy)) if entropy > self._config.vague_nats else 1.0

    # --- into the graph ---------------------------------------------------------------------------
    def needs_update(self) -> bool:
        """Whether the graph is to take in what waits; to be asked once a keyframe."""
        config = self._config
        if not self._waiting:
            return False
        weight = sum(self.weight(seen.entropy) for seen in self._waiting if not seen.is_miss)
        is_enough = weight >= config.due_weight or len(self._waiting) >= config.most_waiting
        if config.schedule == "fixed" or is_enough:
            return True
        self.skipped += 1
        return False

    def update_graph(self, graph: PoseGraph) -> None:
        """What waits goes into the graph, what is gone leaves it, and distributions are fused."""
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
            return  # sent again after a restart
        old = old or Landmark(Evidence.none(MAX_CLASSES), np.full(MAX_CLASSES, 1 / MAX_CLASSES))
        evidence = old.evidence.with_observed(seen.distribution, self.weight(seen.entropy))
        sights = (*old.sights, self._sight(seen)) if seen.is_whole else old.sights
        self.known[seen.landmark] = replace(
            old, evidence=evidence, sights=sights, misses=0, last=seen.keyframe
        )

    def _sight(self, seen: LandmarkObservation) -> BoxObservation:
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
        """Those that a keyframe shows together."""
        shown: dict[int, set[int]] = {}
        for seen in waiting:
            if not seen.is_miss:
                shown.setdefault(seen.keyframe, set()).add(seen.landmark)
        for together in shown.values():
            self._pairs |= set(itertools.combinations(sorted(together), 2))

    def _see(self, graph: PoseGraph, waiting: set[Pair]) -> None:
        """Sights of landmarks in the graph, and all of those that can be placed by now."""
        new, placed, gone = [], {}, []
        for k in sorted({landmark for _, landmark in waiting}):
            sights = [s for s in self.known[k].sights if s.keyframe in graph]
            kept = self._thinned(sights)
            self.known[k] = replace(self.known[k], sights=kept)
            if graph.has_landmark(k):
                left = {s.keyframe for s in kept}
                gone += [(s.keyframe, k) for s in sights if s.keyframe not in left]
                new += [s for s in kept if (s.keyframe, k) in waiting]
            elif (point := self._triangulated(kept, graph)) is not None:
                placed[k] = point
                new += kept
        if new:
            graph.add_observations(new, placed)
        graph.remove_observations(gone)

    def _thinned(self, sights: list[BoxObservation]) -> tuple[BoxObservation, ...]:
        """The first ones, which tie it to where it was, and the newest."""
        half = self._config.most_sights // 2
        excess = len(sights) - self._config.most_sights
        return tuple(sights if excess <= 0 else sights[:half] + sights[half + excess :])

    def _triangulated(
        self, sights: Iterable[BoxObservation], graph: PoseGraph
    ) -> np.ndarray | None:
        """Where the rays through the centres of boxes meet [3]; None where that says nothing: too
        few, too small an angle, behind a camera, or not in the boxes."""
        sights = list(sights)
        if len(sights) < self._config.least_sights:
            return None
        T_map = np.array([graph.pose(s.keyframe) for s in sights])
        fx, fy, cx, cy = np.array([s.intrinsics for s in sights]).T
        u, v = np.array([s.center_px for s in sights]).T
        rays = np.stack([(u - cx) / fx, (v - cy) / fy, np.ones(len(sights))], axis=1)
        try:
            point, parallax_rad = triangulate(
                T_map[:, :3, 3], (T_map[:, :3, :3] @ rays[..., None])[..., 0]
            )
        except np.linalg.LinAlgError:
            return None
        p = (se3.inverse(T_map) @ np.append(point, 1))[:, :3]
        if parallax_rad < self._config.least_parallax_rad or p[:, 2].min() <= 0.1:
            return None
        off_px = np.hypot(fx * p[:, 0] / p[:, 2] + cx - u, fy * p[:, 1] / p[:, 2] + cy - v)
        sigmas_px = np.array([s.sigma_px for s in sights])
        return point if np.all(off_px < 3 * sigmas_px) else None

    # --- what they are ----------------------------------------------------------------------------
    def _fuse(self, touched: set[int]) -> None:
        """Of those observed anew; the others are as they were."""
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

    # --- out again --------------------------------------------------------------------------------
    def _remove_lost(self, graph: PoseGraph) -> None:
        """With their observations: a dense factor among all keyframes that saw one would cost more
        than it says, and hold them where they are today."""
        newest = graph.newest or 0
        gone = [k for k, landmark in self.known.items() if self._is_gone(landmark, newest)]
        by_age = sorted(self.known.keys() - set(gone), key=lambda k: (self.known[k].last, k))
        gone += by_age[: max(0, len(by_age) - self._config.most)]
        for k in gone:
            graph.remove_observations((s.keyframe, k) for s in self.known.pop(k).sights)
        self._pairs = {pair for pair in self._pairs if set(pair) <= self.known.keys()}

    def _is_gone(self, landmark: Landmark, newest: int) -> bool:
        config = self._config
        if landmark.misses >= config.misses:
            return True
        is_vague = landmark.entropy > config.vague_nats
        is_past = newest - landmark.last > config.vague_keyframes
        return is_vague and (landmark.misses >= config.vague_misses or is_past)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """`known` is the same object until the next `update_graph`."""
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
            "sights": pack_sights(s for one in known for s in one.sights),
            "pairs": sorted(self._pairs),
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        packed = state["known"]
        sights: dict[int, list[BoxObservation]] = {}
        for sight in unpack_sights(packed["sights"]):
            sights.setdefault(sight.landmark, []).append(sight)
        columns = (packed[n] for n in ("ids", "weights", "log_sums", "distributions", "misses"))
        self.known = {
            k: Landmark(Evidence(weight, log_sum), p, tuple(sights.get(k, ())), *misses)
            for k, weight, log_sum, p, misses in zip(*columns, strict=True)
        }
        self._pairs = {(i, j) for i, j in packed["pairs"]}
        self._waiting = [LandmarkObservation.unpack(values) for values in state["waiting"]]
        self.skipped = state["skipped"]
