"""A server that is asked over HTTP: patiently, not too often, and never for longer than allowed."""

import asyncio
import os
import ssl
import time
from collections.abc import Callable
from dataclasses import dataclass

import httpx2

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
        self._address = str(_address(url))
        self._headers = {
            "Content-Type": "application/json",
            "Accept-Encoding": "identity",  # The answer is read as it comes, not unpacked.
            **_key(config.key_variable),
        }
        self._tls = ssl.create_default_context()
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
                return self._attempt(path, body, within_s)
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

    def _attempt(self, path: str, body: bytes, within_s: float) -> bytes:
        """Return the answer to one attempt.

        Raises:
            _TransientError: Another attempt may succeed.
            EndpointError: The server refuses the question, or answers too much.
        """
        self.attempts += 1
        try:
            return asyncio.run(self._exchange(path, body, within_s))
        except TimeoutError as error:
            raise _TransientError(f"did not answer within {within_s:.1f} s") from error
        except httpx2.TransportError as error:
            raise _TransientError(
                f"cannot be asked: {type(error).__name__} {error}".strip()
            ) from error

    async def _exchange(self, path: str, body: bytes, within_s: float) -> bytes:
        """Send a question and read its answer, in one connection.

        The timeouts of the library are of each read alone, and a server that sends a byte now and
        then would never reach them. So one timeout is set around all of it, connecting included.
        Proxies of the environment are not used, and redirects are not followed: the key would go
        to another host.
        """
        async with (
            asyncio.timeout(within_s),
            httpx2.AsyncClient(verify=self._tls, trust_env=False, timeout=None) as client,
            client.stream(
                "POST", self._address + path, content=body, headers=self._headers
            ) as response,
        ):
            answer = b""
            async for piece in response.aiter_raw():
                answer += piece
                if len(answer) > MAX_BYTES:
                    raise EndpointError(f"{self.url} answers more than {MAX_BYTES} bytes.")
        status = f"answers {response.status_code} {response.reason_phrase[:40]}"
        if response.status_code in RETRY_STATUS_CODES:
            raise _TransientError(status)
        if response.status_code != 200:
            raise EndpointError(
                f"{self.url} {status}: check the address (often it ends in /v1), the name of the "
                "model and the key."
            )
        return answer


class _TransientError(Exception):
    """A failure that another attempt may not meet."""


def _address(url: str) -> httpx2.URL:
    """Return where to ask. Raises ConfigError."""
    try:
        address = httpx2.URL(url.rstrip("/"))
    except httpx2.InvalidURL:
        address = httpx2.URL()
    port = 80 if address.port is None else address.port
    is_usable = address.scheme in ("http", "https") and address.host and 0 < port < 65536
    if not is_usable or "?" in url or "#" in url:
        raise ConfigError(
            f"{_without_user(url)!r} is no address of a server: write it as "
            "http://127.0.0.1:8000/v1."
        )
    if address.userinfo:
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
