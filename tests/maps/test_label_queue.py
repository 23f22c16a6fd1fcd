"""Tests of the queue of label requests before a slow labeller."""

import msgspec

from ldo_service.maps import label_queue
from ldo_service.maps.label_queue import LabelRequestQueue
from ldo_service.schemas import LabelRequest
from tests.schemas.examples import EXAMPLES


def request(region: int, keyframe: int = 0) -> LabelRequest:
    return msgspec.structs.replace(EXAMPLES["label_request"], region=region, keyframe=keyframe)


def regions(requests: list[LabelRequest]) -> list[int]:
    return [one.region for one in requests]


def queue_of(surfaces_m2: dict[int, float]) -> LabelRequestQueue:
    queue = LabelRequestQueue()
    for region, surface_m2 in surfaces_m2.items():
        queue.add(request(region), surface_m2)
    return queue


def test_labeller_with_room_for_all_gets_the_requests_in_order() -> None:
    queue = queue_of({3: 0.1, 1: 0.9, 2: 0.5})
    assert regions(queue.take(3)) == [3, 1, 2]
    assert len(queue) == 0


def test_slow_labeller_gets_the_largest_new_surface_first() -> None:
    queue = queue_of({3: 0.1, 1: 0.9, 2: 0.5})
    assert regions(queue.take(1)) == [1]
    assert regions(queue.take(0)) == []
    queue.add(request(1, keyframe=5), 1.0)  # It shows 0.1 m2 more than its last request.
    assert regions(queue.take(1)) == [2]
    assert len(queue) == 2


def test_newer_request_replaces_that_of_its_region() -> None:
    queue = queue_of({1: 0.2})
    (replaced,) = queue.add(request(1, keyframe=7), 0.1)
    assert (replaced.region, replaced.keyframe) == (1, 0)
    (sent,) = queue.take(5)
    assert sent.keyframe == 7


def test_full_queue_displaces_the_least_new_surface(monkeypatch) -> None:
    monkeypatch.setattr(label_queue, "MAX_WAITING", 2)
    queue = queue_of({1: 0.2, 2: 0.4})
    assert regions(queue.add(request(3), 0.3)) == [1]
    assert regions(queue.add(request(4), 0.1)) == [4]
    assert sorted(regions(queue.take(9))) == [2, 3]


def test_restored_queue_continues_equally() -> None:
    queue = queue_of({3: 0.1, 1: 0.9, 2: 0.5})
    queue.take(1)
    restored = LabelRequestQueue.unpack(queue.pack())
    for one in (queue, restored):
        one.add(request(1, keyframe=5), 0.95)
    assert restored.take(2) == queue.take(2)
    assert restored.take(9) == queue.take(9)
