"""Tests of the Prometheus metrics, which are made from health messages."""

import re
import socket
import threading
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import ExitStack, suppress

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from ldo_service.errors import ConfigError
from ldo_service.schemas import encode
from ldo_service.service.metrics import COMES_BACK_S, HealthCollector
from ldo_service.service.metrics_server import MAX_CONNECTIONS, serve_metrics
from tests.ports import free_port
from tests.schemas.examples import EXAMPLES


@pytest.fixture
def port() -> Iterator[int]:
    """Yield the port on which the example health message is exported."""
    collector, port = HealthCollector("mule", ["mapper"]), free_port()
    collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    collector.on_health(b"", memoryview(b"\xc1 no health message"))
    with serve_metrics(collector, port):
        yield port


def scraped(port: int) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Return the value of each metric by name and labels, read with the parser of Prometheus."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as reply:
        text = reply.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def labels(*own: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((("robot", "mule"), *own)))


def read_healthz(port: int, path: str = "healthz") -> tuple[int, str]:
    """Return the status and text of /healthz or /readyz."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/{path}", timeout=60) as reply:
            return reply.status, reply.read().decode().strip()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode().strip()


def test_healthz_requires_a_recent_heartbeat_of_every_actor(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    collector, port = HealthCollector("mule", ["mapper", "tracker"]), free_port()
    mapper = EXAMPLES["health"]  # Past failures and restarts do not count.
    with serve_metrics(collector, port):
        assert read_healthz(port) == (503, "no heartbeat: mapper, tracker")
        collector.on_health(b"", memoryview(encode(mapper)))
        assert read_healthz(port) == (503, "no heartbeat: tracker")
        tracker = msgspec.structs.replace(mapper, actor="tracker")
        collector.on_health(b"", memoryview(encode(tracker)))
        assert read_healthz(port) == (200, "every actor reports")
        later_s = time.monotonic() + 2 * (10 + COMES_BACK_S)
        monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
        assert read_healthz(port) == (503, "no heartbeat: mapper, tracker")


def test_readyz_names_an_actor_that_fails_on_every_message_and_healthz_does_not() -> None:
    collector, port = HealthCollector("mule", ["mapper"]), free_port()
    with serve_metrics(collector, port):
        for failing, expected in (
            (True, (503, "failing on every message: mapper")),
            (False, (200, "every actor reports")),
        ):
            health = msgspec.structs.replace(EXAMPLES["health"], failing=failing)
            collector.on_health(b"", memoryview(encode(health)))
            assert read_healthz(port, "readyz") == expected
            assert read_healthz(port) == (200, "every actor reports")


class Beats:
    """Collector that receives made-up heartbeats of one actor, twice a second."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, actor: str) -> None:
        self.collector = HealthCollector("mule", [actor])
        self._health = msgspec.structs.replace(EXAMPLES["health"], actor=actor)
        self._now_s = time.monotonic()
        monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: self._now_s)

    def hear(self, seconds: float, *, queued: int = 4, is_handling: bool = False, **fields) -> None:
        """Receive heartbeats for a time, with `queued` messages; `is_handling` counts steps."""
        count = msgspec.structs.replace(self._health.inputs[0], queued=queued)
        for _ in range(round(2 * seconds)):
            self._now_s += 0.5
            steps = self._health.steps + is_handling
            values = {"steps": steps, "current_step_s": 0.0, "inputs": (count,), **fields}
            self._health = msgspec.structs.replace(self._health, **values)
            self.collector.on_health(b"", memoryview(encode(self._health)))

    def wait(self, seconds: float) -> None:
        """Let time pass without a heartbeat."""
        self._now_s += seconds


def test_readyz_names_an_actor_that_takes_none_of_its_queued_messages_and_healthz_does_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats, port = Beats(monkeypatch, "mapper"), free_port()
    with serve_metrics(beats.collector, port):
        beats.hear(10, is_handling=True, step_age_s=0.1)
        assert read_healthz(port, "readyz") == (200, "every actor reports")
        beats.hear(8, step_age_s=8.0)
        assert read_healthz(port, "readyz") == (
            503,
            "mapper took none of 4 queued messages for 8 s: it waits until a consumer takes its "
            "outputs; check the actors that consume them",
        )
        assert read_healthz(port) == (200, "every actor reports")
        beats.hear(0.5, is_handling=True, step_age_s=0.1)
        assert read_healthz(port, "readyz") == (200, "every actor reports")


def test_actor_makes_no_progress_only_after_the_time_that_doctor_allows(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats = Beats(monkeypatch, "optimizer")
    beats.hear(1, is_handling=True, step_age_s=0.1)
    beats.hear(4.5, step_age_s=5.0)
    assert beats.collector.stalls() == []
    beats.hear(1, step_age_s=6.0)
    (text,) = beats.collector.stalls()
    assert text.startswith("optimizer took none of 4 queued messages for 6 s")


def test_actor_that_cannot_save_is_not_ready_and_the_text_says_to_free_disk_space(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats = Beats(monkeypatch, "mapper")
    beats.hear(8, step_age_s=8.0, metrics={"checkpoint_failing": 1.0})
    (text,) = beats.collector.stalls()
    assert text.endswith(": free some disk space, because it cannot save its last step")


@pytest.mark.parametrize(
    ("actor", "fields", "text"),
    [
        ("mapper", {"current_step_s": 12.0}, "busy with one message for 12 s, with 4 more queued"),
        ("mapper", {"current_step_s": 4.0}, None),
        ("mapper", {"current_step_s": 12.0, "queued": 0}, None),  # The step delays no message.
        ("optimizer", {"current_step_s": 500.0}, None),  # The step limit of a back end is 600 s.
        ("vlm_labeller", {"current_step_s": 500.0, "metrics": {"attempts": 2.0}}, None),
    ],
)
def test_long_step_makes_the_service_not_ready_only_if_poses_or_the_map_wait_for_it(
    monkeypatch: pytest.MonkeyPatch, actor: str, fields: dict, text: str | None
) -> None:
    beats = Beats(monkeypatch, actor)
    beats.hear(20, step_age_s=20.0, **fields)
    assert [text in stall for stall in beats.collector.stalls()] == ([True] if text else [])


def test_readyz_says_that_the_service_is_paused_and_stays_ready(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats, port = Beats(monkeypatch, "frame_source"), free_port()
    beats.hear(60, paused=True, step_age_s=60.0)
    with serve_metrics(beats.collector, port):
        status, text = read_healthz(port, "readyz")
        assert status == 200
        assert text == (
            "every actor reports; frame_source is paused and takes no messages: run `ldo control "
            "resume` to continue"
        )
    beats.hear(1, paused=False, step_age_s=61.0)
    assert beats.collector.stalls() == [], "it had no time to take a message since the pause"


def test_first_message_after_a_time_without_a_camera_is_no_missing_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats = Beats(monkeypatch, "mapper")
    beats.hear(60, queued=0, step_age_s=60.0)
    beats.hear(2, step_age_s=62.0)  # The actor saves its first step.
    assert beats.collector.stalls() == []


def test_time_without_heartbeats_and_old_heartbeats_are_no_missing_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats = Beats(monkeypatch, "mapper")
    beats.hear(1, step_age_s=0.1)
    beats.wait(600)  # The machine was suspended.
    beats.hear(1, step_age_s=600.0)
    assert beats.collector.stalls() == []
    beats.hear(8, step_age_s=608.0)
    assert len(beats.collector.stalls()) == 1
    beats.wait(10 + COMES_BACK_S)
    assert beats.collector.stalls() == [], "the actor is silent"


def test_actor_that_discards_each_message_is_failing_instead_of_without_progress(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    beats = Beats(monkeypatch, "mapper")
    for dead_lettered in range(10):
        beats.hear(1, step_age_s=60.0, dead_lettered=dead_lettered, failing=True)
    assert (beats.collector.stalls(), beats.collector.failing_actors()) == ([], ["mapper"])


def test_certificate_that_expires_within_30_days_is_a_metric_and_a_warning_of_readyz() -> None:
    collector, port = HealthCollector("mule", ["mapper"]), free_port()
    collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    name = "ldo_certificate_expiry_seconds"
    with serve_metrics(collector, port):
        assert (name, labels()) not in scraped(port), "a service without keys has no certificate"
        collector.certificate_until_s = time.time() + 31 * 86_400
        assert 30 * 86_400 < scraped(port)[name, labels()] < 31 * 86_400
        assert read_healthz(port, "readyz") == (200, "every actor reports")
        collector.certificate_until_s = time.time() + 9.96 * 86_400
        status, text = read_healthz(port, "readyz")
        assert status == 200
        assert text == "every actor reports; the certificate of the service expires in 10.0 days"


def test_age_of_the_older_generation_is_a_metric_and_above_a_minute_a_warning_of_readyz() -> None:
    collector, port = HealthCollector("mule"), free_port()
    name = "ldo_generation_age_seconds"
    with serve_metrics(collector, port):
        assert (name, labels()) not in scraped(port), "a temporary state has no older generation"
        collector.generation_age_s = lambda: 59.0
        assert scraped(port)[name, labels()] == 59
        assert read_healthz(port, "readyz") == (200, "every actor reports")
        collector.generation_age_s = lambda: 61.0
        status, text = read_healthz(port, "readyz")
        assert status == 200
        assert text.startswith("every actor reports; the generation of the states to which the ")
        assert "is out of date for 61 s" in text


def test_actor_is_silent_only_after_its_heartbeat_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    slow, quick = (HealthCollector("mule", ["mapper"], silent_s) for silent_s in (60, 5))
    for collector in (slow, quick):
        collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    later_s = time.monotonic() + 30
    monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
    assert (slow.silent_actors(), quick.silent_actors()) == ([], ["mapper"])


@pytest.mark.parametrize("address", ["localhost", "127.0.0.1", "::1"])
def test_metrics_are_served_on_any_local_address(address: str) -> None:
    port = free_port()
    # IPv6 may be missing on this machine.
    with (
        suppress(ConfigError),
        serve_metrics(HealthCollector("mule"), port, address),
    ):
        url = f"http://{f'[{address}]' if ':' in address else address}:{port}/healthz"
        with urllib.request.urlopen(url, timeout=60) as reply:
            assert reply.status == 200
            return
    assert address == "::1", "only IPv6 may be missing"


def test_idle_connections_take_no_threads_and_keep_no_reader_out() -> None:
    port = free_port()
    with serve_metrics(HealthCollector("mule"), port), ExitStack() as idle:
        threads = threading.active_count()
        for number in range(4 * MAX_CONNECTIONS):
            connection = socket.create_connection(("127.0.0.1", port), timeout=60)
            idle.callback(connection.close)
            if number % 2:
                connection.sendall(b"GET /metrics HT")
        assert read_healthz(port)[0] == 200
        until_s = time.monotonic() + 60
        while threading.active_count() - threads > MAX_CONNECTIONS:
            assert time.monotonic() < until_s
            time.sleep(0.01)


def test_backlog_of_the_slowest_consumer_is_exported() -> None:
    collector, port = HealthCollector("mule"), free_port()
    (view,) = EXAMPLES["health"].outputs
    view = msgspec.structs.replace(
        view, behind={"detector": 3, "loop_closer": 12}, backlog_mb=1.5, backlog_dropped=2
    )
    health = msgspec.structs.replace(EXAMPLES["health"], outputs=(view,))
    collector.on_health(b"", memoryview(encode(health)))
    with serve_metrics(collector, port):
        values = scraped(port)
    names = labels(("actor", "mapper"), ("topic", "map/view"))
    assert values["ldo_output_backlog_messages", names] == 12
    assert values["ldo_output_backlog_mb", names] == 1.5
    assert values["ldo_output_backlog_dropped_total", names] == 2


def test_every_value_of_a_health_message_is_exported(port: int) -> None:
    values = scraped(port)
    mapper = ("actor", "mapper")
    keyframes, view = ("topic", "keyframe/new"), ("topic", "map/view")
    expected = {
        ("ldo_steps_total", labels(mapper)): 100,
        ("ldo_failures_total", labels(mapper)): 2,
        ("ldo_restarts_total", labels(mapper)): 2,
        ("ldo_process_restarts_total", labels(mapper)): 0,
        ("ldo_dead_letters_total", labels(mapper)): 1,
        ("ldo_quarantined_total", labels(mapper)): 0,
        ("ldo_failing", labels(mapper)): 0,
        ("ldo_step_age_seconds", labels(mapper)): 0.25,
        ("ldo_current_step_seconds", labels(mapper)): 0.125,
        ("ldo_step_seconds", labels(mapper, ("quantile", "0.5"))): 0.02,
        ("ldo_step_seconds", labels(mapper, ("quantile", "0.95"))): 0.0315,
        ("ldo_resident_bytes", labels(mapper)): 512.5e6,
        ("ldo_paused", labels(mapper)): 0,
        ("ldo_input_messages_total", labels(mapper, keyframes)): 90,
        ("ldo_input_dropped_total", labels(mapper, keyframes)): 0,
        ("ldo_input_rejected_total", labels(mapper, keyframes)): 1,
        ("ldo_input_dropped_paused_total", labels(mapper, keyframes)): 0,
        ("ldo_input_lost_total", labels(mapper, keyframes)): 0,
        ("ldo_input_gaps_total", labels(mapper, keyframes)): 2,
        ("ldo_input_queued", labels(mapper, keyframes)): 3,
        ("ldo_output_messages_total", labels(mapper, view)): 90,
        ("ldo_output_backpressure_waits_total", labels(mapper, view)): 4,
        ("ldo_output_evicted_total", labels(mapper, view)): 1,
        ("ldo_output_retransmitted_total", labels(mapper, view)): 3,
        ("ldo_output_backlog_messages", labels(mapper, view)): 0,
        ("ldo_output_backlog_mb", labels(mapper, view)): 0,
        ("ldo_output_backlog_dropped_total", labels(mapper, view)): 0,
        ("ldo_actor_metric", labels(mapper, ("metric", "gaussians"))): 1000,
    }
    age = values.pop(("ldo_heartbeat_age_seconds", labels(mapper)))
    assert age >= 0
    assert values == pytest.approx(expected)


def test_killed_actor_is_counted_and_its_gauges_disappear(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    collector, health = HealthCollector("mule"), EXAMPLES["health"]
    for pid in (7, 7, 8, 8, 9):
        restarted = msgspec.structs.replace(health, pid=pid)
        collector.on_health(b"", memoryview(encode(restarted)))
    samples = {s.name: s.value for family in collector.collect() for s in family.samples}
    assert samples["ldo_process_restarts_total"] == 2
    assert "ldo_resident_bytes" in samples
    later_s = time.monotonic() + 60
    monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
    samples = {s.name: s.value for family in collector.collect() for s in family.samples}
    assert samples["ldo_heartbeat_age_seconds"] > 30
    assert all(name.endswith("_total") for name in samples if name != "ldo_heartbeat_age_seconds")
    assert samples["ldo_steps_total"] == 100


def test_metrics_are_reachable_from_this_machine_only(port: int) -> None:
    with socket.socket() as probe:
        try:
            probe.connect((_own_address(), port))
        except OSError:
            return
    pytest.fail("the port answers on an address of the network")


def _own_address() -> str:
    """Return the network address of this machine, or a second loopback address without one."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # This sends no packet.
            return probe.getsockname()[0]
        except OSError:
            return "127.0.0.2"


def test_used_port_is_reported_and_reusable_after_closing(port: int) -> None:
    with (
        pytest.raises(ConfigError, match=re.escape(f"cannot listen on 127.0.0.1:{port}")),
        serve_metrics(HealthCollector("mule"), port),
    ):
        pass
    other = free_port()
    for _ in range(2):
        with serve_metrics(HealthCollector("mule"), other):
            assert scraped(other) == {}


@pytest.mark.parametrize("port_", [0, -1, 65536])
def test_invalid_port_is_rejected(port_: int) -> None:
    with pytest.raises(ConfigError), serve_metrics(HealthCollector("mule"), port_):
        pass
