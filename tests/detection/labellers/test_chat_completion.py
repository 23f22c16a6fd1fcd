"""HTTP labeller: valid replies and every kind of failure."""

import base64
import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from math import sqrt

import cv2
import numpy as np
import pytest

from ldo_service.detection.labellers.chat_completion import HttpConfig, HttpLabeller
from ldo_service.detection.labellers.http_endpoint import HttpClientConfig
from ldo_service.errors import ConfigError, EndpointError

from .encoders import plain_image
from .server import (
    cuts_off,
    hangs,
    hangs_up,
    redirects,
    replies_with,
    responds,
    serving,
    trickles,
    trickles_headers,
)

RED = plain_image("red")
NAMES = ("cup", "sofa", "samovar")


@dataclass
class FakeClock:
    now_s: float = 100.0

    def clock(self) -> float:
        return self.now_s

    def sleep(self, for_s: float) -> None:
        assert for_s > 0
        self.now_s += for_s


def labeller(url: str, names=NAMES, time: FakeClock | None = None, **fields) -> HttpLabeller:
    time = time or FakeClock()
    endpoint = HttpClientConfig(**fields.pop("endpoint", {}))
    config = HttpConfig(model="llava", endpoint=endpoint, **fields)
    return HttpLabeller(url, config, names, time.clock, time.sleep)


def test_request_follows_openai_schema_and_contains_the_crop() -> None:
    with serving(replies_with("cup", 0.5)) as server:
        labeller(server.url).label([RED])
    (request,) = server.requests
    assert server.paths == ["/v1/chat/completions"]
    assert (request["model"], request["logprobs"], request["temperature"]) == ("llava", True, 0)
    text, image = request["messages"][0]["content"]
    assert "cup, couch, samovar" in text["text"]
    prefix, data = image["image_url"]["url"].split(",")
    assert prefix == "data:image/jpeg;base64"
    image_sent = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert image_sent.shape == RED.shape
    assert image_sent[..., 2].min() > 240


def test_large_crop_is_downscaled() -> None:
    with serving(replies_with("cup", 0.5)) as server:
        labeller(server.url, side_px=50).label([plain_image("red", 100, 200)])
    data = server.requests[0]["messages"][0]["content"][1]["image_url"]["url"].split(",")[1]
    image_sent = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert image_sent.shape == (25, 50, 3)


@pytest.mark.parametrize(
    ("method", "expected"), [("product", 0.9 * 0.4), ("mean", sqrt(0.9 * 0.4))]
)
def test_confidence_is_computed_from_tokens_of_the_name(method, expected: float) -> None:
    with serving(replies_with("samovar", 0.9, 0.4)) as server:
        labels = labeller(server.url, confidence=method).label([RED])
    assert labels == [("samovar", pytest.approx(expected))]


def test_views_are_fused_up_to_the_configured_number() -> None:
    with serving(
        replies_with("cup", 0.9),
        replies_with("sofa", 0.8),
        replies_with("couch", 0.7),
        replies_with("x"),
    ) as server:
        client = labeller(server.url, views=3)
        assert client.label([RED] * 5) == [
            ("couch", pytest.approx(0.5)),
            ("cup", pytest.approx(0.3)),
        ]
    assert client.metrics()["questions"] == 3


def test_missing_logprobs_give_default_confidence_and_one_warning(caplog) -> None:
    with serving(replies_with("cup")) as server:
        client = labeller(server.url, views=1)
        for _ in range(3):
            assert client.label([RED]) == [("cup", 0.3)]
    (record,) = caplog.records
    assert "returns no log-probabilities" in record.getMessage()
    assert client.metrics()["answers_without_logprobs"] == 3


@pytest.mark.parametrize(
    ("text", "name"),
    [("Cup.", "cup"), ("a SOFA", "couch"), ('"the samovar"', "samovar"), ("cup<|im_end|>", "cup")],
)
def test_reply_is_normalized_to_a_name(text: str, name: str) -> None:
    with serving(replies_with(text, 0.5)) as server:
        assert labeller(server.url, views=1).label([RED])[0][0] == name


@pytest.mark.parametrize(
    "text",
    ["teapot", "I think this is a cup", "cup, sofa", "", "42", "cup" * 60, "杯子", "```cup```{}"],
)
def test_reply_outside_the_names_is_rejected_and_counted(text: str) -> None:
    with serving(replies_with(text, 0.99)) as server:
        client = labeller(server.url, views=1)
        assert client.label([RED]) == []
    assert client.metrics()["answers_refused"] == 1


def test_reply_none_gives_no_label_and_is_counted() -> None:
    with serving(replies_with("None.", 0.99)) as server:
        client = labeller(server.url, views=1)
        assert client.label([RED]) == []
        assert (client.metrics()["answers_refused"], client.metrics()["answers_none"]) == (0, 1)


def test_open_vocabulary_accepts_any_name_but_no_sentence() -> None:
    sentence = "well this may be some kind of samovar"
    with serving(
        replies_with("Tea_pot", 0.8), replies_with(sentence, 0.8), replies_with("unknown", 0.9)
    ) as server:
        client = labeller(server.url, names=(), views=1)
        assert client.label([RED]) == [("tea pot", pytest.approx(0.8))]
        assert client.label([RED]) == client.label([RED]) == []
        assert client.names == ()
        assert "Which of these" not in server.requests[0]["messages"][0]["content"][0]["text"]
        with pytest.raises(ConfigError, match="has no list of names"):
            client.add("teapot")


def test_added_name_is_in_the_next_request() -> None:
    with serving(replies_with("teapot", 0.8)) as server:
        client = labeller(server.url, views=1)
        assert client.label([RED]) == []
        client.add("Teapot")
        assert client.label([RED]) == [("teapot", pytest.approx(0.8))]
    assert "samovar, teapot" in server.requests[-1]["messages"][0]["content"][0]["text"]


# --- server failures ------------------------------------------------------------------------------
@pytest.mark.parametrize(
    "failure",
    [responds(500), responds(429), hangs_up, cuts_off],
    ids=["500", "429", "disconnected", "truncated"],
)
def test_transient_failures_are_retried_with_growing_delays(failure: Callable) -> None:
    time = FakeClock()
    with serving(failure, failure, replies_with("cup", 0.5)) as server:
        client = labeller(server.url, time=time, views=1, endpoint={"per_minute": 1e9})
        assert client.label([RED]) == [("cup", pytest.approx(0.5))]
    assert client.metrics()["attempts"] == 3
    assert time.now_s == pytest.approx(100 + 0.5 + 1.0)


def test_circuit_breaker_delay_grows_with_repeated_failures() -> None:
    time, attempts = FakeClock(), []
    with serving(responds(500)) as server:
        client = labeller(server.url, time=time, endpoint={"attempts": 2, "per_minute": 1e9})
        for _ in range(100):
            with pytest.raises(EndpointError):
                client.label([RED])
            attempts.append(client.metrics()["attempts"])
            time.now_s += 1
        with pytest.raises(EndpointError, match="circuit breaker open"):
            client.label([RED])
    assert attempts[:10] == [2] * 10
    assert attempts[-1] == 2 * 4  # Attempts at 0, 10, 30 and 70 s, plus the waits between.


@pytest.mark.parametrize("status", [400, 401, 404, 302])
def test_permanent_failures_are_not_retried(status: int) -> None:
    with serving(responds(status)) as server:
        client = labeller(server.url)
        with pytest.raises(EndpointError, match=f"answers {status} .*the name of the model"):
            client.label([RED])
    assert len(server.requests) == 1


@pytest.mark.parametrize(
    "hang",
    [hangs, trickles, trickles_headers],
    ids=["hangs", "trickles", "trickles headers"],
)
def test_endless_reply_ends_at_the_timeout(hang: Callable) -> None:
    with serving(hang) as server:
        client = labeller(server.url, endpoint={"timeout_s": 0.2, "attempts": 1})
        with pytest.raises(EndpointError, match=r"did not answer within 0\.2 s"):
            client.label([RED])
    assert client.metrics()["attempts"] == 1


def test_key_is_not_sent_to_redirect_target(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LABELLER_KEY", "sk-secret")
    with (
        serving(replies_with("cup", 0.5)) as other_server,
        serving(redirects(other_server.url)) as server,
    ):
        client = labeller(server.url, endpoint={"key_variable": "LABELLER_KEY"})
        with pytest.raises(EndpointError, match="answers 307"):
            client.label([RED])
    assert (len(server.requests), other_server.requests) == (1, [])


def test_failed_attempts_leak_no_threads_or_files() -> None:
    def open_resources() -> np.ndarray:
        return np.array([threading.active_count(), len(os.listdir("/proc/self/fd"))])

    with serving(responds(404)) as server:
        client = labeller(server.url, endpoint={"pause_s": 0, "per_minute": 1e9})
        before = open_resources()
        for _ in range(20):
            with pytest.raises(EndpointError):
                client.label([RED])
        until_s = time.monotonic() + 30  # The server ends its own threads a little later.
        while (open_resources() > before).any() and time.monotonic() < until_s:
            time.sleep(0.01)
        assert (open_resources() <= before).all()


@contextlib.contextmanager
def silent(host: str, port: int) -> Iterator[int]:
    """Open a port that answers no connection, because its queue is full, and yield the port."""
    with contextlib.ExitStack() as opened:
        full = opened.enter_context(socket.create_server((host, port), backlog=0))
        for _ in range(6):
            queued = opened.enter_context(socket.socket())
            queued.setblocking(False)
            queued.connect_ex(full.getsockname())
        yield full.getsockname()[1]


def resolve_to(monkeypatch: pytest.MonkeyPatch, hosts: Sequence[str], port: int) -> None:
    """Give every host name these addresses."""
    addresses = [(socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, port)) for host in hosts]
    monkeypatch.setattr(socket, "getaddrinfo", lambda *_args, **_kwargs: addresses)


def test_silent_addresses_of_a_server_share_one_timeout(monkeypatch: pytest.MonkeyPatch) -> None:
    with silent("127.0.0.1", 0) as port:
        resolve_to(monkeypatch, ["127.0.0.1"] * 6, port)
        endpoint = {"timeout_s": 1.0, "attempts": 1}
        client = labeller(f"http://six-addresses:{port}/v1", views=1, endpoint=endpoint)
        start_s = time.monotonic()
        with pytest.raises(EndpointError, match=r"did not answer within 1\.0 s"):
            client.label([RED])
        assert time.monotonic() - start_s < 4, "six timeouts one after the other take 6 s"


def test_lookup_of_a_host_name_takes_no_longer_than_the_timeout(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    is_over = threading.Event()

    def look_up(*_args: object, **_kwargs: object) -> None:
        assert is_over.wait(60)
        raise socket.gaierror

    monkeypatch.setattr(socket, "getaddrinfo", look_up)
    client = labeller("http://silent-dns:80/v1", views=1, endpoint={"timeout_s": 0.2})
    try:
        with pytest.raises(EndpointError, match=r"did not answer within 0\.2 s"):
            client.label([RED])
        assert not is_over.is_set(), "the three attempts ended before the lookups did"
    finally:
        is_over.set()


def test_unresponsive_address_falls_back_to_the_next_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with serving(replies_with("cup", 0.5)) as server, contextlib.ExitStack() as opened:
        port = int(server.url.split(":")[2].split("/")[0])
        opened.enter_context(silent("127.0.0.2", port))
        resolve_to(monkeypatch, ["127.0.0.2", "127.0.0.1"], port)
        client = labeller(f"http://two-addresses:{port}/v1", views=1, endpoint={"timeout_s": 30})
        start_s = time.monotonic()
        assert client.label([RED]) == [("cup", pytest.approx(0.5))]
        assert time.monotonic() - start_s < 20


def test_unreachable_server_raises_after_three_attempts() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}/v1"
        with pytest.raises(EndpointError, match=r"cannot be reached.*3 attempts.*server is up"):
            labeller(url).label([RED])


@pytest.mark.parametrize(
    "body",
    [
        b"<html>welcome</html>",
        b"{}",
        b'{"choices": []}',
        b'{"choices": [{"message": {"content": 7}}]}',
        b"[" * 100_000,
        b"\xff\xfe",
        b" " * (1 << 20) + b"{}",
    ],
    ids=["html", "empty", "no choice", "number", "deep", "binary", "huge"],
)
def test_reply_that_is_no_completion_raises(body: bytes) -> None:
    with serving(responds(200, body)) as server, pytest.raises(EndpointError):
        labeller(server.url).label([RED])


@pytest.mark.parametrize("logprob", ['"low"', "0.5", "null", "{}"])
def test_invalid_logprobs_give_default_confidence(logprob: str) -> None:
    entry = f'{{"content": [{{"token": "cup", "logprob": {logprob}}}]}}'
    body = f'{{"choices": [{{"message": {{"content": "cup"}}, "logprobs": {entry}}}]}}'
    with serving(responds(200, body.encode())) as server:
        assert labeller(server.url, views=1).label([RED]) == [("cup", 0.3)]


def test_label_of_first_view_is_kept_when_the_next_one_fails() -> None:
    with serving(replies_with("cup", 0.9), responds(404)) as server:
        assert labeller(server.url).label([RED, RED]) == [("cup", pytest.approx(0.9))]


@pytest.mark.parametrize(("each_s", "requests"), [(5, 3), (13, 3), (15, 2), (25, 1), (40, 1)])
def test_views_of_a_region_share_the_patience(each_s: float, requests: int) -> None:
    time = FakeClock()

    def replies_late(handler: BaseHTTPRequestHandler) -> None:
        time.now_s += each_s
        replies_with("cup", 0.5)(handler)

    with serving(replies_late) as server:
        client = labeller(server.url, time=time, views=3)
        assert client.label([RED] * 3) == [("cup", pytest.approx(0.5))]
    assert len(server.requests) == requests
    assert time.now_s - 100 <= HttpClientConfig().patience_s


@pytest.mark.parametrize(
    ("first_s", "endpoint", "second"),
    [
        (19, {"timeout_s": 30}, [("cup", pytest.approx(0.5))]),  # Ended after 21 of 30 s.
        (19, {"timeout_s": 21}, None),  # The full timeout passed, so the circuit breaker opens.
    ],
)
def test_view_ended_by_patience_does_not_open_the_circuit_breaker(
    first_s: float, endpoint: dict, second: list | None
) -> None:
    time, later_s = FakeClock(), iter([first_s, 21, 0])

    def replies_or_hangs_up(handler: BaseHTTPRequestHandler) -> None:
        wait_s = next(later_s)
        time.now_s += wait_s
        (hangs_up if wait_s == 21 else replies_with("cup", 0.5))(handler)

    with serving(replies_or_hangs_up) as server:
        client = labeller(server.url, time=time, views=2, endpoint={"attempts": 1, **endpoint})
        assert client.label([RED] * 2) == [("cup", pytest.approx(0.5))]
        if second is not None:
            assert client.label([RED]) == second
        else:
            with pytest.raises(EndpointError, match="circuit breaker open"):
                client.label([RED])


def test_patience_below_timeout_raises_config_error() -> None:
    with pytest.raises(ConfigError, match="patience_s=5 must be at least timeout_s=10"):
        HttpClientConfig(patience_s=5)


# --- rate limits and credentials ------------------------------------------------------------------
def test_attempts_are_evenly_spaced() -> None:
    time, times = FakeClock(), []
    with serving(replies_with("cup", 0.5)) as server:
        client = labeller(server.url, time=time, views=1, endpoint={"per_minute": 30})
        for _ in range(4):
            client.label([RED])
            times.append(time.now_s)
    assert times == [100, 102, 104, 106]


def test_rate_limit_delay_above_patience_raises_immediately() -> None:
    time = FakeClock()
    with serving(replies_with("cup", 0.5)) as server:
        limits = {"per_minute": 1, "patience_s": 20}
        client = labeller(server.url, time=time, views=1, endpoint=limits)
        assert client.label([RED])
        with pytest.raises(EndpointError, match=r"http\.deadline_s leaves no time"):
            client.label([RED])
    assert time.now_s == 100
    assert len(server.requests) == 1


def test_key_is_sent_but_never_logged(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("LABELLER_KEY", "sk-secret")
    with serving(replies_with("cup", 0.5), responds(401)) as server:
        client = labeller(server.url, views=1, endpoint={"key_variable": "LABELLER_KEY"})
        client.label([RED])
        with pytest.raises(EndpointError) as caught:
            client.label([RED])
    assert server.keys[0] == "Bearer sk-secret"
    texts = (str(caught.value), caplog.text, client.identity, repr(client.config))
    assert not any("secret" in text for text in texts)


def test_missing_key_variable_raises_config_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LABELLER_KEY", raising=False)
    with pytest.raises(ConfigError, match="LABELLER_KEY"):
        labeller("http://127.0.0.1:1/v1", endpoint={"key_variable": "LABELLER_KEY"})


@pytest.mark.parametrize(
    "url",
    ["", "127.0.0.1:80", "ftp://a/b", "http://", "http://a:b/", "http://a:99999/", "http://a/?q"],
)
def test_invalid_address_raises_config_error(url: str) -> None:
    with pytest.raises(ConfigError, match="not the address of a server"):
        labeller(url)


def test_password_in_the_address_raises_without_repeating_it() -> None:
    with pytest.raises(ConfigError, match="key_variable") as caught:
        labeller("https://me:secret@server/v1")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "fields", [{"confidence": "max"}, {"views": 0}, {"confidence_untold": 2.0}]
)
def test_invalid_settings_raise_config_error(fields: dict) -> None:
    with pytest.raises(ConfigError, match="HttpConfig." + next(iter(fields))):
        HttpConfig(**fields)
    with pytest.raises(ConfigError):
        HttpClientConfig(attempts=0)
