"""Deduplication of a room that was mapped twice, after a correction."""

import numpy as np

from ldo_service.evaluation.views import psnr
from ldo_service.gaussians import render
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import se3

FRAMES, FIRST_REPEATED = (0, 6, 12), 100
T_DRIFT = se3.exp(np.array([0, 0.02, 0, 0.15, 0, 0.1]))


def test_deduplication_shrinks_a_doubled_map_without_loss_of_quality(small_room) -> None:
    posed = {i: small_room(i) for i in (3, 9, *FRAMES)}
    builder = MapBuilder()
    for number, i in enumerate(FRAMES):
        builder.add(*posed[i], number, 10)
    single_size = builder.size()
    for number, i in enumerate(FRAMES, FIRST_REPEATED):
        frame, T_map_camera = posed[i]
        builder.add(frame, T_DRIFT @ T_map_camera, number, 10)
    repeated = range(FIRST_REPEATED, FIRST_REPEATED + len(FRAMES))
    builder.move_keyframes({k: se3.inverse(T_DRIFT) for k in repeated})

    def quality() -> float:
        values = []
        for i in (3, 9):
            frame, T_map_camera = posed[i]
            shown = render(builder.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
            values.append(psnr(shown.clip(0, 1), frame.color / np.float32(255)))
        return float(np.mean(values))

    doubled_size, quality_before = builder.size(), quality()
    removed_count = sum(builder.deduplicate_keyframe(k, 5) for k in repeated)
    assert builder.deduplicate_keyframe(77, 5) == 0, "an unknown keyframe"
    assert doubled_size - builder.size() == removed_count
    assert removed_count > 0.3 * (doubled_size - single_size)
    assert quality() > quality_before
