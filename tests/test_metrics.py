"""Prometheus reads what the actors' health messages say."""

import re
import socket
import urllib.request
from collections.abc import Iterator

import pytest
from prometheus_client.parser import text_string_to_metric_families

from ldo_service.errors import ConfigError
from ldo_service.metrics import HealthCollector, exported
from ldo_service.schemas import encode
from tests.runtime.conftest import free_port
from tests.schemas.examples import EXAMPLES


@pytest.fixture
def port() -> Iterator[int]:
    """Where the example's health is exported."""
    collector, port = HealthCollector(), free_port()
    collector.heard(b"", memoryview(encode(EXAMPLES["health"])))
    collector.heard(b"", memoryview(b"\xc1 no health message"))
    with exported(collector, port):
        yield port


def scraped(port: int) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """Value by name and labels, read by Prometheus's own parser."""
    with urllib.request.urlopen(f"http://127.0.0.1:{port}/metrics", timeout=5) as reply:
        text = reply.read().decode()
    return {
        (sample.name, tuple(sorted(sample.labels.items()))): sample.value
        for family in text_string_to_metric_families(text)
        for sample in family.samples
    }


def test_every_number_of_a_health_message_is_exported(port: int) -> None:
    values = scraped(port)
    mapper = ("actor", "mapper")
    keyframes, view = ("topic", "keyframe/new"), ("topic", "map/view")
    expected = {
        ("ldo_steps_total", (mapper,)): 100,
        ("ldo_failures_total", (mapper,)): 2,
        ("ldo_restarts_total", (mapper,)): 2,
        ("ldo_set_aside_total", (mapper,)): 1,
        ("ldo_step_age_seconds", (mapper,)): 0.25,
        ("ldo_busy_seconds", (mapper,)): 0.125,
        ("ldo_step_seconds", (mapper, ("quantile", "0.5"))): 0.02,
        ("ldo_step_seconds", (mapper, ("quantile", "0.95"))): 0.0315,
        ("ldo_resident_bytes", (mapper,)): 512.5e6,
        ("ldo_held", (mapper,)): 0,
        ("ldo_input_delivered_total", (mapper, keyframes)): 90,
        ("ldo_input_dropped_total", (mapper, keyframes)): 0,
        ("ldo_input_rejected_total", (mapper, keyframes)): 1,
        ("ldo_input_paused_total", (mapper, keyframes)): 0,
        ("ldo_input_lost_total", (mapper, keyframes)): 0,
        ("ldo_input_gaps_total", (mapper, keyframes)): 2,
        ("ldo_input_waiting", (mapper, keyframes)): 3,
        ("ldo_output_sent_total", (mapper, view)): 90,
        ("ldo_output_waited_total", (mapper, view)): 4,
        ("ldo_output_evicted_total", (mapper, view)): 1,
        ("ldo_output_repeated_total", (mapper, view)): 3,
        ("ldo_fact", (mapper, ("fact", "gaussians"))): 1000,
    }
    age = values.pop(("ldo_heartbeat_age_seconds", (mapper,)))
    assert age >= 0
    assert values == pytest.approx(expected)


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
        exported(HealthCollector(), port),
    ):
        pass
    other = free_port()
    for _ in range(2):
        with exported(HealthCollector(), other):
            assert scraped(other) == {}


@pytest.mark.parametrize("port_", [0, -1, 65536])
def test_an_impossible_port_is_refused(port_: int) -> None:
    with pytest.raises(ConfigError), exported(HealthCollector(), port_):
        pass
