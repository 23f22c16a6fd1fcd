"""A labeller behind a server: good answers, and every kind of bad one."""

import base64
import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from http.server import BaseHTTPRequestHandler
from math import sqrt

import cv2
import numpy as np
import pytest

from ldo_service.detection.labellers.chat_completion import HttpConfig, HttpLabeller
from ldo_service.detection.labellers.http_endpoint import HttpClientConfig
from ldo_service.errors import ConfigError, EndpointError

from .encoders import plain
from .server import (
    breaks_off,
    hangs,
    hangs_up,
    redirects,
    says,
    sends,
    serving,
    trickles,
    trickles_headers,
)

RED = plain("red")
NAMES = ("cup", "sofa", "samovar")


@dataclass
class Time:
    now_s: float = 100.0

    def clock(self) -> float:
        return self.now_s

    def sleep(self, for_s: float) -> None:
        assert for_s > 0
        self.now_s += for_s


def labeller(url: str, names=NAMES, time: Time | None = None, **fields) -> HttpLabeller:
    time = time or Time()
    endpoint = HttpClientConfig(**fields.pop("endpoint", {}))
    config = HttpConfig(model="llava", endpoint=endpoint, **fields)
    return HttpLabeller(url, config, names, time.clock, time.sleep)


def test_the_question_is_as_openai_has_it_and_shows_the_crop() -> None:
    with serving(says("cup", 0.5)) as server:
        labeller(server.url).label([RED])
    (question,) = server.asked
    assert server.paths == ["/v1/chat/completions"]
    assert (question["model"], question["logprobs"], question["temperature"]) == ("llava", True, 0)
    text, picture = question["messages"][0]["content"]
    assert "cup, couch, samovar" in text["text"]
    kind, data = picture["image_url"]["url"].split(",")
    assert kind == "data:image/jpeg;base64"
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == RED.shape
    assert shown[..., 2].min() > 240


def test_a_large_crop_is_shrunk() -> None:
    with serving(says("cup", 0.5)) as server:
        labeller(server.url, side_px=50).label([plain("red", 100, 200)])
    data = server.asked[0]["messages"][0]["content"][1]["image_url"]["url"].split(",")[1]
    shown = cv2.imdecode(np.frombuffer(base64.b64decode(data), np.uint8), cv2.IMREAD_COLOR)
    assert shown.shape == (25, 50, 3)


@pytest.mark.parametrize(("how", "expected"), [("product", 0.9 * 0.4), ("mean", sqrt(0.9 * 0.4))])
def test_confidence_comes_from_the_tokens_that_spell_the_name(how, expected: float) -> None:
    with serving(says("samovar", 0.9, 0.4)) as server:
        opinions = labeller(server.url, confidence=how).label([RED])
    assert opinions == [("samovar", pytest.approx(expected))]


def test_views_are_fused_and_no_more_than_configured_are_asked() -> None:
    with serving(says("cup", 0.9), says("sofa", 0.8), says("couch", 0.7), says("x")) as server:
        one = labeller(server.url, views=3)
        assert one.label([RED] * 5) == [("couch", pytest.approx(0.5)), ("cup", pytest.approx(0.3))]
    assert one.metrics()["questions"] == 3


def test_without_log_probabilities_confidence_is_low_and_said_so(caplog) -> None:
    with serving(says("cup")) as server:
        one = labeller(server.url, views=1)
        for _ in range(3):
            assert one.label([RED]) == [("cup", 0.3)]
    (record,) = caplog.records
    assert "returns no log-probabilities" in record.getMessage()
    assert one.metrics()["answers_without_logprobs"] == 3


@pytest.mark.parametrize(
    ("text", "name"),
    [("Cup.", "cup"), ("a SOFA", "couch"), ('"the samovar"', "samovar"), ("cup<|im_end|>", "cup")],
)
def test_an_answer_is_read_as_people_write(text: str, name: str) -> None:
    with serving(says(text, 0.5)) as server:
        assert labeller(server.url, views=1).label([RED])[0][0] == name


@pytest.mark.parametrize(
    "text",
    ["teapot", "I think this is a cup", "cup, sofa", "", "42", "cup" * 60, "杯子", "```cup```{}"],
)
def test_an_answer_that_is_none_of_the_names_is_refused_and_counted(text: str) -> None:
    with serving(says(text, 0.99)) as server:
        one = labeller(server.url, views=1)
        assert one.label([RED]) == []
    assert one.metrics()["answers_refused"] == 1


def test_none_is_an_honest_answer() -> None:
    with serving(says("None.", 0.99)) as server:
        one = labeller(server.url, views=1)
        assert one.label([RED]) == []
        assert (one.metrics()["answers_refused"], one.metrics()["answers_none"]) == (0, 1)


def test_an_open_question_takes_any_name_and_no_sentence() -> None:
    long = "well this may be some kind of samovar"
    with serving(says("Tea_pot", 0.8), says(long, 0.8), says("unknown", 0.9)) as server:
        one = labeller(server.url, names=(), views=1)
        assert one.label([RED]) == [("tea pot", pytest.approx(0.8))]
        assert one.label([RED]) == one.label([RED]) == []
        assert one.names == ()
        assert "Which of these" not in server.asked[0]["messages"][0]["content"][0]["text"]
        with pytest.raises(ConfigError, match="may answer any name"):
            one.add("teapot")


def test_a_name_that_is_added_is_asked_for() -> None:
    with serving(says("teapot", 0.8)) as server:
        one = labeller(server.url, views=1)
        assert one.label([RED]) == []
        one.add("Teapot")
        assert one.label([RED]) == [("teapot", pytest.approx(0.8))]
    assert "samovar, teapot" in server.asked[-1]["messages"][0]["content"][0]["text"]


# --- servers that misbehave -----------------------------------------------------------------------
@pytest.mark.parametrize(
    "trouble",
    [sends(500), sends(429), hangs_up, breaks_off],
    ids=["500", "429", "gone", "cut short"],
)
def test_what_may_pass_is_tried_again_with_growing_pauses(trouble: Callable) -> None:
    time = Time()
    with serving(trouble, trouble, says("cup", 0.5)) as server:
        one = labeller(server.url, time=time, views=1, endpoint={"per_minute": 1e9})
        assert one.label([RED]) == [("cup", pytest.approx(0.5))]
    assert one.metrics()["attempts"] == 3
    assert time.now_s == pytest.approx(100 + 0.5 + 1.0)


def test_a_server_that_keeps_failing_is_left_alone_for_longer_and_longer() -> None:
    time, attempts = Time(), []
    with serving(sends(500)) as server:
        one = labeller(server.url, time=time, endpoint={"attempts": 2, "per_minute": 1e9})
        for _ in range(100):
            with pytest.raises(EndpointError):
                one.label([RED])
            attempts.append(one.metrics()["attempts"])
            time.now_s += 1
        with pytest.raises(EndpointError, match="circuit breaker open"):
            one.label([RED])
    assert attempts[:10] == [2] * 10
    assert attempts[-1] == 2 * 4  # at 0, 10, 30 and 70 s, and the waits between attempts


@pytest.mark.parametrize("status", [400, 401, 404, 302])
def test_what_will_not_pass_is_not_tried_again(status: int) -> None:
    with serving(sends(status)) as server:
        one = labeller(server.url)
        with pytest.raises(EndpointError, match=f"answers {status} .*the name of the model"):
            one.label([RED])
    assert len(server.asked) == 1


@pytest.mark.parametrize(
    "way",
    [hangs, trickles, trickles_headers],
    ids=["hangs", "trickles", "trickles headers"],
)
def test_a_server_that_never_ends_its_answer_is_not_waited_for(way: Callable) -> None:
    with serving(way) as server:
        one = labeller(server.url, endpoint={"timeout_s": 0.2, "attempts": 1})
        with pytest.raises(EndpointError, match=r"did not answer within 0\.2 s"):
            one.label([RED])
    assert one.metrics()["attempts"] == 1


def test_the_key_is_not_sent_to_where_a_server_redirects(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("LABELLER_KEY", "sk-secret")
    with serving(says("cup", 0.5)) as other, serving(redirects(other.url)) as server:
        one = labeller(server.url, endpoint={"key_variable": "LABELLER_KEY"})
        with pytest.raises(EndpointError, match="answers 307"):
            one.label([RED])
    assert (len(server.asked), other.asked) == (1, [])


def test_an_attempt_leaves_no_thread_and_no_file_open() -> None:
    def left() -> np.ndarray:
        return np.array([threading.active_count(), len(os.listdir("/proc/self/fd"))])

    with serving(sends(404)) as server:
        one = labeller(server.url, endpoint={"rest_s": 0, "per_minute": 1e9})
        before = left()
        for _ in range(20):
            with pytest.raises(EndpointError):
                one.label([RED])
        until_s = time.monotonic() + 30  # The server ends its own threads a little later.
        while (left() > before).any() and time.monotonic() < until_s:
            time.sleep(0.01)
        assert (left() <= before).all()


def test_an_address_that_hangs_does_not_keep_the_next_one_waiting(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The first address takes no more connections: its queue is full."""
    with serving(says("cup", 0.5)) as server, contextlib.ExitStack() as opened:
        port = int(server.url.split(":")[2].split("/")[0])
        full = opened.enter_context(socket.create_server(("127.0.0.2", port), backlog=0))
        for _ in range(6):
            queued = opened.enter_context(socket.socket())
            queued.setblocking(False)
            queued.connect_ex(full.getsockname())
        found = [
            (socket.AF_INET, socket.SOCK_STREAM, 6, "", (host, port))
            for host in ("127.0.0.2", "127.0.0.1")
        ]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_args, **_kwargs: found)
        one = labeller(f"http://two-addresses:{port}/v1", views=1, endpoint={"timeout_s": 30})
        start_s = time.monotonic()
        assert one.label([RED]) == [("cup", pytest.approx(0.5))]
        assert time.monotonic() - start_s < 20


def test_no_server_at_all() -> None:
    with socket.socket() as closed:
        closed.bind(("127.0.0.1", 0))
        url = f"http://127.0.0.1:{closed.getsockname()[1]}/v1"
        with pytest.raises(EndpointError, match=r"cannot be reached.*3 attempts.*is the server up"):
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
def test_an_answer_that_is_no_completion_is_an_error(body: bytes) -> None:
    with serving(sends(200, body)) as server, pytest.raises(EndpointError):
        labeller(server.url).label([RED])


@pytest.mark.parametrize("logprob", ['"low"', "0.5", "null", "{}"])
def test_log_probabilities_that_are_none_do_not_count(logprob: str) -> None:
    entry = f'{{"content": [{{"token": "cup", "logprob": {logprob}}}]}}'
    body = f'{{"choices": [{{"message": {{"content": "cup"}}, "logprobs": {entry}}}]}}'
    with serving(sends(200, body.encode())) as server:
        assert labeller(server.url, views=1).label([RED]) == [("cup", 0.3)]


def test_a_view_that_was_answered_stands_when_the_next_one_fails() -> None:
    with serving(says("cup", 0.9), sends(404)) as server:
        assert labeller(server.url).label([RED, RED]) == [("cup", pytest.approx(0.9))]


@pytest.mark.parametrize(("each_s", "asked"), [(5, 3), (13, 3), (15, 2), (25, 1), (40, 1)])
def test_all_views_of_a_region_together_try_its_patience(each_s: float, asked: int) -> None:
    time = Time()

    def says_late(handler: BaseHTTPRequestHandler) -> None:
        time.now_s += each_s
        says("cup", 0.5)(handler)

    with serving(says_late) as server:
        one = labeller(server.url, time=time, views=3)
        assert one.label([RED] * 3) == [("cup", pytest.approx(0.5))]
    assert len(server.asked) == asked
    assert time.now_s - 100 <= HttpClientConfig().patience_s


@pytest.mark.parametrize(
    ("first_s", "endpoint", "second"),
    [
        (19, {"timeout_s": 30}, [("cup", pytest.approx(0.5))]),  # cut after 21 of its 30 s
        (19, {"timeout_s": 21}, None),  # had its time, and is left alone
    ],
)
def test_a_view_cut_off_by_patience_is_no_failure_of_the_server(
    first_s: float, endpoint: dict, second: list | None
) -> None:
    time, later_s = Time(), iter([first_s, 21, 0])

    def says_or_hangs_up(handler: BaseHTTPRequestHandler) -> None:
        wait_s = next(later_s)
        time.now_s += wait_s
        (hangs_up if wait_s == 21 else says("cup", 0.5))(handler)

    with serving(says_or_hangs_up) as server:
        one = labeller(server.url, time=time, views=2, endpoint={"attempts": 1, **endpoint})
        assert one.label([RED] * 2) == [("cup", pytest.approx(0.5))]
        if second is not None:
            assert one.label([RED]) == second
        else:
            with pytest.raises(EndpointError, match="circuit breaker open"):
                one.label([RED])


def test_a_question_that_may_not_have_one_attempt_s_time_is_refused() -> None:
    with pytest.raises(ConfigError, match="patience_s=5 must be at least timeout_s=10"):
        HttpClientConfig(patience_s=5)


# --- manners --------------------------------------------------------------------------------------
def test_attempts_are_spaced_evenly() -> None:
    time, times = Time(), []
    with serving(says("cup", 0.5)) as server:
        one = labeller(server.url, time=time, views=1, endpoint={"per_minute": 30})
        for _ in range(4):
            one.label([RED])
            times.append(time.now_s)
    assert times == [100, 102, 104, 106]


def test_waiting_for_longer_than_patience_is_refused_at_once() -> None:
    time = Time()
    with serving(says("cup", 0.5)) as server:
        limits = {"per_minute": 1, "patience_s": 20}
        one = labeller(server.url, time=time, views=1, endpoint=limits)
        assert one.label([RED])
        with pytest.raises(EndpointError, match="patience_s"):
            one.label([RED])
    assert time.now_s == 100
    assert len(server.asked) == 1


def test_the_key_is_sent_and_told_to_nobody(monkeypatch: pytest.MonkeyPatch, caplog) -> None:
    caplog.set_level(logging.DEBUG)
    monkeypatch.setenv("LABELLER_KEY", "sk-secret")
    with serving(says("cup", 0.5), sends(401)) as server:
        one = labeller(server.url, views=1, endpoint={"key_variable": "LABELLER_KEY"})
        one.label([RED])
        with pytest.raises(EndpointError) as caught:
            one.label([RED])
    assert server.keys[0] == "Bearer sk-secret"
    told = (str(caught.value), caplog.text, one.identity, repr(one.config))
    assert not any("secret" in text for text in told)


def test_a_key_that_is_not_there_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LABELLER_KEY", raising=False)
    with pytest.raises(ConfigError, match="LABELLER_KEY"):
        labeller("http://127.0.0.1:1/v1", endpoint={"key_variable": "LABELLER_KEY"})


@pytest.mark.parametrize(
    "url",
    ["", "127.0.0.1:80", "ftp://a/b", "http://", "http://a:b/", "http://a:99999/", "http://a/?q"],
)
def test_an_address_that_is_none_is_refused(url: str) -> None:
    with pytest.raises(ConfigError, match="not the address of a server"):
        labeller(url)


def test_a_password_in_the_address_is_refused_and_not_repeated() -> None:
    with pytest.raises(ConfigError, match="key_variable") as caught:
        labeller("https://me:secret@server/v1")
    assert "secret" not in str(caught.value)


@pytest.mark.parametrize(
    "fields", [{"confidence": "max"}, {"views": 0}, {"confidence_untold": 2.0}]
)
def test_settings_that_cannot_be_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError, match="http"):
        HttpConfig(**fields)
    with pytest.raises(ConfigError):
        HttpClientConfig(attempts=0)
