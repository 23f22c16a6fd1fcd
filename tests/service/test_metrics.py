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
