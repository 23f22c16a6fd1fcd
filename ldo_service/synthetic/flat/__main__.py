"""Command that renders a whole sequence into the cache and prints its statistics.

    python -m ldo_service.synthetic.flat [flat | flat-exact | ...] [number of processes]

The statistics show how hard the sequence is: motion, bare walls, missing depth and the number of
visible objects per class.
"""

import os
import sys
from collections import Counter
from dataclasses import dataclass

import numpy as np

from .scene_object import CLASS_NAMES, COCO_COUNT, WALL
from .sequence import FlatSequence, prerender
from .walk import RATE_HZ

VISIBLE_SHARE = 1e-3  # Minimum size of a visible object, fraction of the image: 307 of 640x480 px.


@dataclass(frozen=True, slots=True)
class MotionSpeeds:
    """Camera speeds between consecutive frames."""

    speeds_m_s: np.ndarray  # [N - 1]
    turns_deg_s: np.ndarray  # [N - 1]


@dataclass(frozen=True, slots=True)
class Contents:
    """Statistics of the labels and depth of several frames."""

    wall_share: float  # Fraction of the pixels that show a wall.
    missing_depth_share: float  # Fraction of the pixels without measured depth.
    objects_per_class: dict[str, int]  # Number of objects visible in at least one frame.

    @property
    def coco_classes(self) -> int:
        """Number of COCO classes among the visible objects."""
        return sum(name in CLASS_NAMES[:COCO_COUNT] for name in self.objects_per_class)


def motion(T_world_camera: np.ndarray) -> MotionSpeeds:
    """Return the speeds and turn rates of a trajectory.

    Args:
        T_world_camera: Camera poses [N, 4, 4] at RATE_HZ poses per second.
    """
    steps_m = np.diff(T_world_camera[:, :3, 3], axis=0)
    before, after = T_world_camera[:-1, :3, :3], T_world_camera[1:, :3, :3]
    cosines = (np.einsum("nij,nij->n", before, after) - 1) / 2
    turns = np.rad2deg(np.arccos(np.clip(cosines, -1, 1)))
    return MotionSpeeds(np.linalg.norm(steps_m, axis=1) * RATE_HZ, turns * RATE_HZ)


def contents(sequence: FlatSequence, stride: int = 1) -> Contents:
    """Return the label and depth statistics, computed from every `stride`-th frame."""
    seen, walls, missing = set(), [], []
    for index in range(0, len(sequence), stride):
        labels = sequence.labels(index)
        ids, pixels = np.unique(labels.instance_ids, return_counts=True)
        seen.update(ids[(ids > 0) & (pixels >= VISIBLE_SHARE * labels.instance_ids.size)].tolist())
        walls.append(np.mean(labels.class_ids == WALL))
        missing.append(np.mean(sequence.read(index).depth == 0))
    counted = Counter(sequence.things[instance - 1].label for instance in seen)
    return Contents(float(np.mean(walls)), float(np.mean(missing)), dict(sorted(counted.items())))


def main() -> None:
    """Render the sequence and print its statistics."""
    name = sys.argv[1] if len(sys.argv) > 1 else "flat"
    processes = int(sys.argv[2]) if len(sys.argv) > 2 else os.cpu_count() or 1
    sequence = FlatSequence.named(name)
    prerender(sequence.config, processes)
    moved, shown = motion(sequence.truth().T_world_camera), contents(sequence)
    low, high = np.percentile(moved.speeds_m_s, [1, 99])
    print(f"frames           {len(sequence)} in {sequence.cache_folder}")
    print(f"speed            {low:.2f}-{high:.2f} m/s (1st to 99th percentile)")
    print(f"turns            up to {moved.turns_deg_s.max():.0f} deg/s")
    print(f"walls            {100 * shown.wall_share:.0f} % of the pixels")
    print(f"missing depth    {100 * shown.missing_depth_share:.1f} % of the pixels")
    objects, classes = sum(shown.objects_per_class.values()), len(shown.objects_per_class)
    print(f"objects seen     {objects} of {classes} classes, {shown.coco_classes} of them in COCO")
    for label, count in shown.objects_per_class.items():
        print(f"  {count:3d} {label}")


if __name__ == "__main__":
    main()
