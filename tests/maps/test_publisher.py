"""Messages of objects that are kept are those that would be made anew."""

import numpy as np

from ldo_service.conversions.objects import map_objects
from ldo_service.geometry import se3
from ldo_service.maps.publisher import ObjectPublisher
from tests.semantics.scenes import NAMES, THINGS, Stage, poses


def test_what_is_kept_is_what_would_be_made() -> None:
    stage, teller = Stage(), ObjectPublisher()
    counts = set()

    def check() -> None:
        now = stage.objects, NAMES.names, stage.keyframe, 7, 100
        told = teller.message(*now)
        assert told.objects == map_objects(stage.objects.landmarks, NAMES.names)
        counts.add(len(told.objects))

    way = poses(12)
    for _ in stage.walk(THINGS, way):
        check()
    stage.objects.move({k: se3.exp(np.full(6, 0.1)) for k in range(4)})
    check()
    for _ in stage.walk((), np.tile(way[:1], (12, 1, 1))):  # all are taken away
        check()
    assert len(stage.objects) < max(counts)
