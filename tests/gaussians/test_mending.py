"""A passage that had drifted is laid over the first by a correction, and mended."""

import numpy as np

from ldo_service.evaluation.views import psnr
from ldo_service.gaussians import render
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import se3

FRAMES, AGAIN = (0, 6, 12), 100
T_DRIFT = se3.exp(np.array([0, 0.02, 0, 0.15, 0, 0.1]))


def test_a_doubled_room_becomes_single_again_and_looks_no_worse(small_room) -> None:
    posed = {i: small_room(i) for i in (3, 9, *FRAMES)}
    builder = MapBuilder()
    for number, i in enumerate(FRAMES):
        builder.add(*posed[i], number, 10)
    single = builder.size()
    for number, i in enumerate(FRAMES, AGAIN):
        frame, T_map_camera = posed[i]
        builder.add(frame, T_DRIFT @ T_map_camera, number, 10)
    again = range(AGAIN, AGAIN + len(FRAMES))
    builder.move({k: se3.inverse(T_DRIFT) for k in again})

    def quality() -> float:
        values = []
        for i in (3, 9):
            frame, T_map_camera = posed[i]
            shown = render(builder.gaussians.rows, frame.camera, se3.inverse(T_map_camera)).color
            values.append(psnr(shown.clip(0, 1), frame.color / np.float32(255)))
        return float(np.mean(values))

    doubled, before = builder.size(), quality()
    gone = sum(builder.deduplicate_keyframe(k, 5) for k in again)
    assert builder.deduplicate_keyframe(77, 5) == 0, "nobody knows it"
    assert doubled - builder.size() == gone
    assert gone > 0.3 * (doubled - single)
    assert quality() > before
