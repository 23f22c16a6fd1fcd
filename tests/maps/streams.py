"""Map messages of a mapper with random changes."""

import numpy as np

from ldo_service.conversions.poses import pose_to_message
from ldo_service.gaussians.model import GaussianMap
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import se3
from ldo_service.maps.messages import NO_GAUSSIANS, NO_IDS, gaussians_message, rechunk
from ldo_service.schemas import AnchorMotion, Array, Gaussians, MapDelta, MapSnapshot


def random_rows(rng: np.random.Generator, count: int) -> np.ndarray:
    """Return Gaussian rows [N, 16] of some centimeters in size, within 4 m."""
    rows = aligned_rows(count)
    rows[:, 0:3] = rng.uniform(-2, 2, (count, 3))
    rows[:, 3:6] = rng.uniform(-6, -3, (count, 3))
    rows[:, 6:10] = rng.normal(size=(count, 4))
    rows[:, 10] = rng.normal(size=count)
    rows[:, 11:14] = rng.uniform(0, 1, (count, 3))
    return rows


class ChangingMap:
    """Reference map that changes at random and gives the messages of its changes."""

    def __init__(self, seed: int = 0) -> None:
        self.map, self.version = GaussianMap(), 0
        self._rng = np.random.default_rng(seed)

    def delta(self) -> MapDelta:
        """Move a keyframe, remove, change and add Gaussians, and return the map delta."""
        motion = self._move(int(self._rng.integers(4)))
        removed = self.map.ids[self._random_mask(0.1)].copy()
        self.map.remove(np.isin(self.map.ids, removed))
        changed = np.flatnonzero(self._random_mask(0.3))
        self.map.rows[changed] = random_rows(self._rng, len(changed))
        first = len(self.map)
        self.map.add(random_rows(self._rng, 50), anchor=int(self._rng.integers(4)))
        return self._delta(
            (motion,), removed, self._gaussians_at(changed), self._gaussians_at(slice(first, None))
        )

    def _delta(
        self,
        motions: tuple[AnchorMotion, ...] = (),
        removed: np.ndarray = NO_IDS,
        changed: Gaussians = NO_GAUSSIANS,
        added: Gaussians = NO_GAUSSIANS,
    ) -> MapDelta:
        self.version += 1
        return MapDelta(
            stamp_ns=0,
            base_version=self.version - 1,
            version=self.version,
            graph_version=0,
            motions=motions,
            removed=Array.of(removed),
            changed=changed,
            added=added,
        )

    def snapshot(self, parts: int = 3) -> list[MapSnapshot]:
        batches = rechunk([self.map.all()], parts, -(-len(self.map) // parts))
        return [
            MapSnapshot(
                stamp_ns=0,
                version=self.version,
                graph_version=0,
                part=part,
                parts=parts,
                gaussians=gaussians,
            )
            for part, gaussians in enumerate(batches)
        ]

    def _move(self, keyframe: int) -> AnchorMotion:
        pose = pose_to_message(se3.exp(0.1 * self._rng.normal(size=6)))
        T = se3.from_quaternion(np.array(pose.translation), np.array(pose.quaternion))
        self.map.move_anchors({keyframe: T})
        return AnchorMotion(keyframe=keyframe, T_new_old=pose)

    def _random_mask(self, ratio: float) -> np.ndarray:
        return self._rng.uniform(size=len(self.map)) < ratio

    def _gaussians_at(self, where: np.ndarray | slice) -> Gaussians:
        return gaussians_message(self.map.all().at(where))
