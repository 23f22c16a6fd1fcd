"""Prometheus reads what the actors' health messages say."""

import re
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import suppress

import msgspec
import pytest
from prometheus_client.parser import text_string_to_metric_families

from ldo_service.errors import ConfigError
from ldo_service.schemas import encode
from ldo_service.service.metrics import COMES_BACK_S, HealthCollector, serve_metrics
from tests.ports import free_port
from tests.schemas.examples import EXAMPLES


@pytest.fixture
def port() -> Iterator[int]:
    """Where the example's health is exported."""
    collector, port = HealthCollector("mule", ["mapper"]), free_port()
    collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    collector.on_health(b"", memoryview(b"\xc1 no health message"))
    with serve_metrics(collector, port):
        yield port


def scraped(port: int) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Value by name and labels, read by Prometheus's own parser."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=60) as reply:
        text = reply.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def labels(*own: tuple[str, str]) -> tuple[tuple[str, str], ...]:
    return tuple(sorted((("robot", "mule"), *own)))


def asked(port: int) -> tuple[int, str]:
    """Status and text of /healthz."""
    try:
        with urllib.request.urlopen(f"http://127.0.0.1:{port}/healthz", timeout=60) as reply:
            return reply.status, reply.read().decode().strip()
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode().strip()


def test_health_is_of_now_and_of_every_actor(monkeypatch: pytest.MonkeyPatch) -> None:
    collector, port = HealthCollector("mule", ["mapper", "tracker"]), free_port()
    mapper = EXAMPLES["health"]  # it has failed and was restarted, which is past
    with serve_metrics(collector, port):
        assert asked(port) == (503, "no heartbeat: mapper, tracker")
        collector.on_health(b"", memoryview(encode(mapper)))
        assert asked(port) == (503, "no heartbeat: tracker")
        tracker = msgspec.structs.replace(mapper, actor="tracker")
        collector.on_health(b"", memoryview(encode(tracker)))
        assert asked(port) == (200, "every actor reports")
        later_s = time.monotonic() + 2 * (10 + COMES_BACK_S)
        monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
        assert asked(port) == (503, "no heartbeat: mapper, tracker")


def test_who_may_be_silent_for_long_is_not_missed_before(monkeypatch: pytest.MonkeyPatch) -> None:
    patient, hasty = (HealthCollector("mule", ["mapper"], silent_s) for silent_s in (60, 5))
    for collector in (patient, hasty):
        collector.on_health(b"", memoryview(encode(EXAMPLES["health"])))
    later_s = time.monotonic() + 30
    monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
    assert (patient.silent_actors(), hasty.silent_actors()) == ([], ["mapper"])


@pytest.mark.parametrize("address", ["localhost", "127.0.0.1", "::1"])
def test_any_address_of_this_machine_will_do(address: str) -> None:
    port = free_port()
    with (
        suppress(ConfigError),
        serve_metrics(HealthCollector("mule"), port, address),
    ):  # no IPv6 here
        url = f"http://{f'[{address}]' if ':' in address else address}:{port}/healthz"
        with urllib.request.urlopen(url, timeout=60) as reply:
            assert reply.status == 200
            return
    assert address == "::1", "only IPv6 may be missing"


def test_every_number_of_a_health_message_is_exported(port: int) -> None:
    values = scraped(port)
    mapper = ("actor", "mapper")
    keyframes, view = ("topic", "keyframe/new"), ("topic", "map/view")
    expected = {
        ("ldo_steps_total", labels(mapper)): 100,
        ("ldo_failures_total", labels(mapper)): 2,
        ("ldo_restarts_total", labels(mapper)): 2,
        ("ldo_process_restarts_total", labels(mapper)): 0,
        ("ldo_dead_letters_total", labels(mapper)): 1,
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
        ("ldo_actor_metric", labels(mapper, ("metric", "gaussians"))): 1000,
    }
    age = values.pop(("ldo_heartbeat_age_seconds", labels(mapper)))
    assert age >= 0
    assert values == pytest.approx(expected)


def test_an_actor_that_was_killed_is_counted_and_its_gauges_go(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    collector, health = HealthCollector("mule"), EXAMPLES["health"]
    for pid in (7, 7, 8, 8, 9):
        again = msgspec.structs.replace(health, pid=pid)
        collector.on_health(b"", memoryview(encode(again)))
    samples = {s.name: s.value for family in collector.collect() for s in family.samples}
    assert samples["ldo_process_restarts_total"] == 2
    assert "ldo_resident_bytes" in samples
    later_s = time.monotonic() + 60
    monkeypatch.setattr("ldo_service.service.metrics.time.monotonic", lambda: later_s)
    samples = {s.name: s.value for family in collector.collect() for s in family.samples}
    assert samples["ldo_heartbeat_age_seconds"] > 30
    assert all(name.endswith("_total") for name in samples if name != "ldo_heartbeat_age_seconds")
    assert samples["ldo_steps_total"] == 100


def test_only_this_machine_can_read_them(port: int) -> None:
    with socket.socket() as probe:
        try:
            probe.connect((_own_address(), port))
        except OSError:
            return
    pytest.fail("the port answers on an address of the network")


def _own_address() -> str:
    """Of this machine on its network; loopback's second address where it has none."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))  # sends nothing
            return probe.getsockname()[0]
        except OSError:
            return "127.0.0.2"


def test_a_taken_port_is_said_and_can_be_had_again_afterwards(port: int) -> None:
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
def test_an_impossible_port_is_refused(port_: int) -> None:
    with pytest.raises(ConfigError), serve_metrics(HealthCollector("mule"), port_):
        pass
