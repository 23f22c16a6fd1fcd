"""Messages of objects that are kept are those that would be made anew."""

import numpy as np

from ldo_service.conversions.objects import map_objects
from ldo_service.geometry import se3
from ldo_service.maps.publisher import ObjectPublisher
from tests.semantics.scenes import NAMES, SCENE_OBJECTS, LabelledMap, poses


def test_what_is_kept_is_what_would_be_made() -> None:
    labelled_map, teller = LabelledMap(), ObjectPublisher()
    counts = set()

    def check() -> None:
        now = labelled_map.objects, NAMES.names, labelled_map.keyframe, 7, 100
        told = teller.message(*now)
        assert told.objects == map_objects(labelled_map.objects.landmarks, NAMES.names)
        counts.add(len(told.objects))

    path = poses(12)
    for _ in labelled_map.walk(SCENE_OBJECTS, path):
        check()
    labelled_map.objects.move({k: se3.exp(np.full(6, 0.1)) for k in range(4)})
    check()
    for _ in labelled_map.walk((), np.tile(path[:1], (12, 1, 1))):  # all are taken away
        check()
    assert len(labelled_map.objects) < max(counts)
