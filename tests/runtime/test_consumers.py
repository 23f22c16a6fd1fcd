from ldo_service.runtime.actor import UNLIMITED
from ldo_service.runtime.consumers import Consumers
from ldo_service.transport.flow_control import ConsumerHello, Credit


def test_credit_is_limited_by_the_slowest_consumer() -> None:
    consumers = Consumers([])
    assert consumers.credits(seq=5) == UNLIMITED
    for name, limit in (("one", 12), ("other", 9)):
        consumers.join(ConsumerHello(name), 5)
        consumers.grant(Credit(name, 1, 5, 5, limit))
    assert [consumers.credits(seq) for seq in (5, 8, 9, 10)] == [4, 1, 0, 0]


def test_late_credit_of_previous_process_does_not_hide_missing_messages() -> None:
    consumers = Consumers(["mapper"])
    consumers.join(ConsumerHello("mapper"), 0)
    consumers.grant(Credit("mapper", 1, handled=3, arrived=7, limit=11))
    consumers.leave("mapper")
    consumers.join(ConsumerHello("mapper"), 8)
    assert consumers.next_seq_by_consumer() == {"mapper": 3}
    # This credit of the previous process was still in transit.
    consumers.grant(Credit("mapper", 1, handled=3, arrived=7, limit=11))
    assert consumers.grant(Credit("mapper", 1, handled=3, arrived=3, limit=11)).arrived == 3
    assert not consumers.all_received(8)


def test_only_consumers_with_exhausted_window_are_stalled() -> None:
    consumers = Consumers(["dead"])
    for name in ("exhausted", "moving"):
        consumers.join(ConsumerHello(name), 0)
        consumers.grant(Credit(name, 1, 0, 0, 4))
    assert consumers.stalled(now_s=0, patience_s=10, seq=4) == []
    consumers.grant(Credit("moving", 1, 1, 4, 5))
    assert consumers.stalled(now_s=9, patience_s=10, seq=5) == []
    assert consumers.stalled(now_s=11, patience_s=10, seq=5) == ["exhausted"]


def test_evicted_consumer_returns_after_handling_a_message() -> None:
    consumers = Consumers(["mapper"])
    consumers.join(ConsumerHello("mapper"), 0)
    consumers.grant(Credit("mapper", 1, 2, 4, 6))
    consumers.evict("mapper")
    assert consumers.credits(4) == 0
    assert consumers.is_still_stuck(Credit("mapper", 1, 2, 4, 6))
    assert not consumers.is_still_stuck(Credit("mapper", 1, 3, 4, 7))


def test_evicted_consumer_that_received_no_message_returns_with_its_next_credit() -> None:
    consumers = Consumers(["mapper"])
    consumers.join(ConsumerHello("mapper"), 0)
    consumers.grant(Credit("mapper", 1, handled=2, arrived=2, limit=4))
    consumers.evict("mapper")
    unchanged = Credit("mapper", 1, handled=2, arrived=2, limit=4)
    assert not consumers.is_still_stuck(unchanged)
    assert consumers.grant(unchanged).arrived == 2, "messages 2 and 3 are retransmitted"


def test_consumer_waiting_for_its_disk_is_not_stalled() -> None:
    consumers = Consumers(["mapper"])
    consumers.join(ConsumerHello("mapper"), 0)
    waiting = Credit("mapper", 1, 0, 4, 4, waits_for_disk=True)
    for now_s in range(0, 60, 5):
        consumers.grant(waiting)
        assert consumers.stalled(now_s, patience_s=10, seq=4) == []
    assert consumers.stalled(now_s=71, patience_s=10, seq=4) == ["mapper"], "its heartbeats stopped"


def test_lost_message_of_a_backlog_is_sent_again_although_newer_ones_follow_it() -> None:
    consumers = Consumers(["detector"], with_backlog=["detector"])
    consumers.join(ConsumerHello("detector", has_backlog=True), 0)
    granted = Credit("detector", 1, handled=0, arrived=0, limit=64, gap=True)
    consumers.grant(granted)
    assert list(consumers.next_of_backlog("detector", 0, 0.0, 0.25)) == []
    for seq in range(5):  # Message 0 is lost, and a new message follows five times a second.
        now_s = 1.0 + 0.2 * seq
        consumers.note_sent(seq, now_s)
        consumers.grant(granted)
        again = consumers.next_of_backlog("detector", seq + 1, now_s + 0.15, 0.25)
        assert list(again) == {0: [], 1: [0, 1], 2: [], 3: [0, 1, 2, 3], 4: []}[seq]
