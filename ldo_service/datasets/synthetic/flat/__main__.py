"""Render the whole flat into the cache and print its statistics.

python -m ldo_service.datasets.synthetic.flat [flat | flat-exact] [PROCESSES]
"""

import os
import sys

import numpy as np

from .prerender import prerender
from .sequence import FlatSequence
from .statistics import contents, motion


def main() -> None:
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
