"""Cached object messages against newly converted ones."""

import numpy as np

from ldo_service.conversions.objects import map_objects
from ldo_service.geometry import se3
from ldo_service.maps.publisher import ObjectPublisher
from tests.semantics.scenes import NAMES, SCENE_OBJECTS, LabelledMap, poses


def test_cached_objects_equal_newly_converted_objects() -> None:
    labelled_map, publisher = LabelledMap(), ObjectPublisher()
    counts = set()

    def check_message() -> None:
        arguments = labelled_map.objects, NAMES.names, labelled_map.keyframe, 7, 100
        message = publisher.message(*arguments)
        assert message.objects == map_objects(labelled_map.objects.landmarks, NAMES.names)
        counts.add(len(message.objects))

    path = poses(12)
    for _ in labelled_map.walk(SCENE_OBJECTS, path):
        check_message()
    labelled_map.objects.move({k: se3.exp(np.full(6, 0.1)) for k in range(4)})
    check_message()
    # The camera stays at one pose and no object is detected.
    for _ in labelled_map.walk((), np.tile(path[:1], (12, 1, 1))):
        check_message()
    assert len(labelled_map.objects) < max(counts)
