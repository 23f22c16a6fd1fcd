from ldo_service.runtime.actor import UNLIMITED
from ldo_service.runtime.consumers import Consumers
from ldo_service.transport.flow_control import Credit


def test_room_is_that_of_the_consumer_with_the_least() -> None:
    consumers = Consumers([])
    assert consumers.room(seq=5) == UNLIMITED
    for name, limit in (("one", 12), ("other", 9)):
        consumers.join(name, 5)
        consumers.grant(Credit(name, 1, 5, 5, limit))
    assert [consumers.room(seq) for seq in (5, 8, 9, 10)] == [4, 1, 0, 0]


def test_a_late_grant_of_a_predecessor_does_not_hide_what_its_successor_lacks() -> None:
    consumers = Consumers(["mapper"])
    consumers.join("mapper", 0)
    consumers.grant(Credit("mapper", 1, handled=3, arrived=7, limit=11))
    consumers.leave("mapper")
    consumers.join("mapper", 8)
    assert consumers.next_seq_by_consumer() == {"mapper": 3}
    consumers.grant(Credit("mapper", 1, handled=3, arrived=7, limit=11))  # was still on its way
    assert consumers.grant(Credit("mapper", 1, handled=3, arrived=3, limit=11)).arrived == 3
    assert not consumers.all_received(8)


def test_only_consumers_whose_window_stays_shut_are_overdue() -> None:
    consumers = Consumers(["dead"])
    for name in ("shut", "moving"):
        consumers.join(name, 0)
        consumers.grant(Credit(name, 1, 0, 0, 4))
    assert consumers.stalled(now_s=0, patience_s=10, seq=4) == []
    consumers.grant(Credit("moving", 1, 1, 4, 5))
    assert consumers.stalled(now_s=9, patience_s=10, seq=5) == []
    assert consumers.stalled(now_s=11, patience_s=10, seq=5) == ["shut"]


def test_an_evicted_consumer_is_back_when_it_has_handled_something() -> None:
    consumers = Consumers(["mapper"])
    consumers.join("mapper", 0)
    consumers.grant(Credit("mapper", 1, 2, 4, 6))
    consumers.evict("mapper")
    assert consumers.room(4) == 0
    assert consumers.is_still_stuck(Credit("mapper", 1, 2, 4, 6))
    assert not consumers.is_still_stuck(Credit("mapper", 1, 3, 4, 7))


def test_who_waits_for_its_disk_is_not_overdue() -> None:
    consumers = Consumers(["mapper"])
    consumers.join("mapper", 0)
    waits = Credit("mapper", 1, 0, 4, 4, waits_for_disk=True)
    for now_s in range(0, 60, 5):
        consumers.grant(waits)
        assert consumers.stalled(now_s, patience_s=10, seq=4) == []
    assert consumers.stalled(now_s=71, patience_s=10, seq=4) == ["mapper"], "it went silent"
