"""A server that is asked over HTTP: patiently, not too often, and never for longer than allowed."""

import os
import socket
import ssl
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from http.client import HTTPConnection, HTTPException, HTTPResponse, HTTPSConnection
from threading import Timer
from urllib.parse import SplitResult, urlsplit

from ldo_service.errors import ConfigError, EndpointError, named

MAX_BYTES = 1 << 20  # of an answer
RETRY_STATUS_CODES = (408, 425, 429, 500, 502, 503, 504)  # what a later attempt may find otherwise


@dataclass(frozen=True, slots=True)
class HttpClientConfig:
    """How long, how often."""

    timeout_s: float = 10.0  # of one attempt
    attempts: int = 3
    backoff_s: float = 0.5  # before the second attempt; doubled before each further one
    patience_s: float = 40.0  # of a region, with all its views, attempts and waits; below
    # supervision.step_timeout_s, at which an actor is given up
    per_minute: float = 60.0  # attempts, evenly spaced
    rest_s: float = 10.0  # after a question that failed, nothing is asked; doubled with each more
    rest_most_s: float = 300.0
    key_variable: str = ""  # name of the environment variable with the API key; empty: none

    def __post_init__(self) -> None:
        times = (self.timeout_s, self.patience_s, self.per_minute)
        if min(times) <= 0 or min(self.backoff_s, self.rest_s, self.rest_most_s) < 0:
            raise ConfigError(
                named(
                    self,
                    "timeout_s",
                    "backoff_s",
                    "patience_s",
                    "per_minute",
                    "rest_s",
                    "rest_most_s",
                )
                + ": times must be positive."
            )
        if self.patience_s < self.timeout_s:
            raise ConfigError(
                f"patience_s={self.patience_s:g} must be at least timeout_s={self.timeout_s:g}, "
                "which one attempt may take."
            )
        if self.attempts < 1:
            raise ConfigError("attempts must be at least 1.")


class DeadlineExceeded(EndpointError):
    """No time is left, and the server did nothing wrong."""


class HttpClient:
    """Asked by one thread.

    url    http or https
    clock  seconds, never backwards; `sleep` waits by it

    Raises ConfigError for an address or a key that cannot be.
    """

    def __init__(
        self,
        url: str,
        config: HttpClientConfig,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        self.url, self._config = url, config
        self._address = _address(url)
        self._headers = {"Content-Type": "application/json", **_key(config.key_variable)}
        self._clock, self._sleep = clock, sleep
        self._free_at_s = self._rested_at_s = float("-inf")
        self._failures = 0  # in a row
        self.attempts = 0

    def post(self, path: str, body: bytes, until_s: float) -> bytes:
        """The answer to a question. Raises EndpointError when there is none by `until_s` of the
        clock; a server that could not have its `timeout_s` until then is not left alone for it."""
        if self._clock() < self._rested_at_s:
            raise EndpointError(f"{self.url} failed before and is left alone for a while.")
        try:
            answer = self._post_with_retries(path, body, until_s)
        except DeadlineExceeded:
            raise
        except EndpointError:
            rest_s = self._config.rest_s * 2 ** min(self._failures, 30)
            self._rested_at_s = self._clock() + min(rest_s, self._config.rest_most_s)
            self._failures += 1
            raise
        self._failures = 0
        return answer

    def _post_with_retries(self, path: str, body: bytes, until_s: float) -> bytes:
        failure = DeadlineExceeded(f"{self.url} may not be asked again within patience_s.")
        for attempt in range(self._config.attempts):
            pause_s = self._config.backoff_s * 2 ** (attempt - 1) if attempt else 0.0
            self._wait(pause_s, until_s, failure)
            within_s = min(self._config.timeout_s, until_s - self._clock())
            try:
                return self._ask(path, body, within_s)
            except _TransientError as passing:
                if within_s < self._config.timeout_s and self._clock() >= until_s:
                    raise failure from passing  # nobody knows what it would have said
                failure = EndpointError(
                    f"{self.url} {passing} ({attempt + 1} attempts): is the server up, and the "
                    "address right?"
                )
        raise failure

    def _wait(self, pause_s: float, until_s: float, failure: EndpointError) -> None:
        """Until the next attempt may be made. Raises `failure` when that is too late."""
        now_s = self._clock()
        start_s = max(now_s + pause_s, self._free_at_s)
        if start_s >= until_s:
            raise failure
        if start_s > now_s:
            self._sleep(start_s - now_s)
        self._free_at_s = start_s + 60 / self._config.per_minute

    def _ask(self, path: str, body: bytes, within_s: float) -> bytes:
        """One attempt. Raises _Passing for what may pass, EndpointError for what will not."""
        self.attempts += 1
        connection = _connection(self._address, within_s)
        try:
            connection.connect()
            with _cut_after(within_s, connection.sock):
                connection.request("POST", self._address.path + path, body, self._headers)
                return _checked(connection.getresponse(), self.url)
        except TimeoutError as error:
            raise _TransientError(f"did not answer within {within_s:.1f} s") from error
        except (OSError, HTTPException, ValueError) as error:
            raise _TransientError(
                f"cannot be asked: {type(error).__name__} {error}".strip()
            ) from error
        finally:
            connection.close()


class _TransientError(Exception):
    """A failure that another attempt may not meet."""


def _checked(response: HTTPResponse, url: str) -> bytes:
    body = response.read(MAX_BYTES + 1)
    if response.status in RETRY_STATUS_CODES:
        raise _TransientError(f"answers {response.status} {response.reason[:40]}")
    if response.status != 200:
        raise EndpointError(
            f"{url} answers {response.status} {response.reason[:40]}: check the address (often it "
            "ends in /v1), the name of the model and the key."
        )
    if len(body) > MAX_BYTES:
        raise EndpointError(f"{url} answers more than {MAX_BYTES} bytes.")
    return body


@contextmanager
def _cut_after(within_s: float, connected: socket.socket) -> Iterator[None]:
    """Whoever reads from it then finds the end. Its own timeout is of each read alone, and a byte
    now and then would keep it waiting for ever."""

    def cut() -> None:
        with suppress(OSError):
            connected.shutdown(socket.SHUT_RDWR)

    watchdog = Timer(within_s, cut)
    watchdog.daemon = True
    watchdog.start()
    try:
        yield
    finally:
        watchdog.cancel()


def _connection(address: SplitResult, timeout_s: float) -> HTTPConnection:
    host = address.hostname or ""
    if address.scheme == "https":
        context = ssl.create_default_context()
        return HTTPSConnection(host, address.port, timeout=timeout_s, context=context)
    return HTTPConnection(host, address.port, timeout=timeout_s)


def _address(url: str) -> SplitResult:
    address = urlsplit(url.rstrip("/"))
    try:
        is_usable = address.scheme in ("http", "https") and address.hostname and address.port != 0
    except ValueError:
        is_usable = False
    if not is_usable or address.query or address.fragment:
        raise ConfigError(
            f"{_without_user(url)!r} is no address of a server: write it as "
            "http://127.0.0.1:8000/v1."
        )
    if address.username or address.password:
        raise ConfigError(
            f"{_without_user(url)!r} has a name or password in it, which every configuration that "
            "is saved would show: put the key into an environment variable and name that in "
            "key_variable."
        )
    return address


def _without_user(url: str) -> str:
    before, at, after = url.partition("@")
    return f"{before.partition('://')[0]}://...@{after}" if at else url


def _key(variable: str) -> dict[str, str]:
    """The header with the key, which is told to nobody else."""
    if not variable:
        return {}
    key = os.environ.get(variable, "").strip()
    if not key or not key.isascii() or not key.isprintable():
        raise ConfigError(
            f"the environment variable {variable} holds no usable API key: set it where the "
            "service is started, or leave key_variable empty."
        )
    return {"Authorization": f"Bearer {key}"}
