"""HTTP client for a labelling server, with retries, a rate limit and a deadline."""

import asyncio
import os
import ssl
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import httpx2

from ldo_service.errors import ConfigError, EndpointError, named

MAX_BYTES = 1 << 20  # Maximum size of a response.
# HTTP status codes of temporary failures, after which another attempt may succeed.
RETRY_STATUS_CODES = (408, 425, 429, 500, 502, 503, 504)


@dataclass(frozen=True, slots=True)
class HttpClientConfig:
    """Timeouts, retries and rate limit of the client."""

    timeout_s: float = 10.0  # Maximum time of one attempt.
    attempts: int = 3  # Maximum attempts of one request.
    backoff_s: float = 0.5  # Pause before the second attempt; doubled before each further one.
    # Maximum time for a region with all its views, attempts and pauses. It must be below
    # supervision.backend_step_timeout_s, after which an actor is stopped.
    patience_s: float = 40.0
    per_minute: float = 60.0  # Maximum attempts per minute, evenly spaced.
    # Time after a failed request in which further requests fail immediately, without an attempt.
    # The time is doubled after each further failure in a row.
    pause_s: float = 10.0
    max_pause_s: float = 300.0  # Maximum of the doubled pause_s.
    key_variable: str = ""  # Environment variable with the API key; empty: none.

    def __post_init__(self) -> None:
        times = (self.timeout_s, self.patience_s, self.per_minute)
        if min(times) <= 0 or min(self.backoff_s, self.pause_s, self.max_pause_s) < 0:
            raise ConfigError(
                named(
                    self,
                    "timeout_s",
                    "backoff_s",
                    "patience_s",
                    "per_minute",
                    "pause_s",
                    "max_pause_s",
                )
                + ": timeout_s, patience_s and per_minute must be positive, the other settings "
                "not negative."
            )
        if self.patience_s < self.timeout_s:
            raise ConfigError(
                f"HttpClientConfig.patience_s={self.patience_s:g} must be at least "
                f"timeout_s={self.timeout_s:g}, the time limit of one attempt."
            )
        if self.attempts < 1:
            raise ConfigError(f"HttpClientConfig.attempts={self.attempts} must be at least 1.")


class DeadlineExceeded(EndpointError):
    """Expiry of the deadline before the server had its full `timeout_s` to respond.

    This error does not count as a failure of the server.
    """


class HttpClient:
    """HTTP client with retries, a rate limit and a circuit breaker, for use by a single thread."""

    def __init__(
        self,
        url: str,
        config: HttpClientConfig,
        clock: Callable[[], float] = time.monotonic,
        sleep: Callable[[float], None] = time.sleep,
    ) -> None:
        """Create a client; no connection is made.

        Args:
            url: Address of the server, http or https.
            config: Settings.
            clock: Monotonic clock, seconds.
            sleep: Function that waits for a number of seconds of this clock.

        Raises:
            ConfigError: If the address or the key is invalid.
        """
        self.url, self._config = url, config
        self._address = str(_address(url))
        self._headers = {
            "Content-Type": "application/json",
            # The response must not be compressed, because `_exchange` reads the raw bytes.
            "Accept-Encoding": "identity",
            **_key(config.key_variable),
        }
        self._tls = ssl.create_default_context()
        self._clock, self._sleep = clock, sleep
        self._free_at_s = self._paused_until_s = float("-inf")
        self._failures = 0  # Failures in a row.
        self.attempts = 0

    def post(self, path: str, body: bytes, until_s: float) -> bytes:
        """Send a POST request, with retries, and return the body of the response.

        For some time after a failed request, further requests fail without an attempt (circuit
        breaker, see `HttpClientConfig.pause_s`). A request whose deadline passes before the server
        had `timeout_s` to respond does not count as failed.

        Args:
            path: Path of the request below the address.
            body: Content of the request, JSON.
            until_s: Deadline, in seconds of the clock that the client was created with.

        Raises:
            DeadlineExceeded: If the deadline passes before the server had `timeout_s` to respond.
            EndpointError: If the circuit breaker is open, all attempts fail or the server rejects
                the request.
        """
        if self._clock() < self._paused_until_s:
            raise EndpointError(
                f"{self.url}: circuit breaker open after a failed request; no request is sent for "
                f"up to {self._config.max_pause_s:g} s. Check that the server is up."
            )
        try:
            answer = self._post_with_retries(path, body, until_s)
        except DeadlineExceeded:
            raise
        except EndpointError:
            pause_s = self._config.pause_s * 2 ** min(self._failures, 30)
            self._paused_until_s = self._clock() + min(pause_s, self._config.max_pause_s)
            self._failures += 1
            raise
        self._failures = 0
        return answer

    def _post_with_retries(self, path: str, body: bytes, until_s: float) -> bytes:
        """Send a request until an attempt succeeds, the server rejects it or no attempt is left."""
        failure = DeadlineExceeded(
            f"{self.url}: vlm_labeller.http.deadline_s leaves no time for another attempt. Raise "
            "it or vlm_labeller.http.max_requests_per_minute, or lower vlm_labeller.http.max_views."
        )
        for attempt in range(self._config.attempts):
            pause_s = self._config.backoff_s * 2 ** (attempt - 1) if attempt else 0.0
            self._wait(pause_s, until_s, failure)
            within_s = min(self._config.timeout_s, until_s - self._clock())
            try:
                return self._attempt(path, body, within_s)
            except _TransientError as passing:
                if within_s < self._config.timeout_s and self._clock() >= until_s:
                    raise failure from passing  # The server did not have its full timeout_s.
                failure = EndpointError(
                    f"{self.url} {passing} ({attempt + 1} attempts): check that the server is up "
                    "and the address is right."
                )
        raise failure

    def _wait(self, pause_s: float, until_s: float, failure: EndpointError) -> None:
        """Wait until the next attempt is allowed.

        Args:
            pause_s: Minimum time to wait.
            until_s: Deadline, in seconds of the clock that the client was created with.
            failure: Error that is raised if the next attempt is not allowed before the deadline.
        """
        now_s = self._clock()
        start_s = max(now_s + pause_s, self._free_at_s)
        if start_s >= until_s:
            raise failure
        if start_s > now_s:
            self._sleep(start_s - now_s)
        self._free_at_s = start_s + 60 / self._config.per_minute

    def _attempt(self, path: str, body: bytes, within_s: float) -> bytes:
        """Make one attempt of a request, and return the body of the response.

        Raises:
            _TransientError: If another attempt may succeed.
            EndpointError: If the server rejects the request or its response is too large.
        """
        self.attempts += 1
        try:
            with asyncio.Runner() as runner:
                runner.get_loop().set_default_executor(_Resolver())
                return runner.run(self._exchange(path, body, within_s))
        except TimeoutError as error:
            raise _TransientError(f"did not answer within {within_s:.1f} s") from error
        except httpx2.TransportError as error:
            raise _TransientError(
                f"cannot be reached: {type(error).__name__} {error}".strip()
            ) from error

    async def _exchange(self, path: str, body: bytes, within_s: float) -> bytes:
        """Send a request and read its response in one connection.

        One timeout covers the whole exchange, including the connection. The timeouts of the library
        apply to each read alone, and a server that sends single bytes would never exceed them.
        Proxies of the environment are not used and redirects are not followed, because the API key
        would go to another host.
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
                    raise EndpointError(
                        f"the response of {self.url} exceeds {MAX_BYTES} bytes: check the address."
                    )
        status = f"answers {response.status_code} {response.reason_phrase[:40]}"
        if response.status_code in RETRY_STATUS_CODES:
            raise _TransientError(status)
        if response.status_code != 200:
            raise EndpointError(
                f"{self.url} {status}: check the address (it often ends in /v1), the name of the "
                "model and the API key."
            )
        return answer


class _Resolver(ThreadPoolExecutor):
    """Thread that looks up the addresses of a host name.

    The lookup has no timeout of its own. The event loop therefore does not wait for a lookup that
    continues after the timeout of the attempt.
    """

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:  # noqa: ARG002
        """Let a running lookup end in the background."""
        super().shutdown(wait=False, cancel_futures=cancel_futures)


class _TransientError(Exception):
    """Temporary failure of an attempt; another attempt may succeed."""


def _address(url: str) -> httpx2.URL:
    """Parse the address of a server.

    Raises:
        ConfigError: If the address is not usable, or contains a user name or password.
    """
    try:
        address = httpx2.URL(url.rstrip("/"))
    except httpx2.InvalidURL:
        address = httpx2.URL()
    port = 80 if address.port is None else address.port
    is_usable = address.scheme in ("http", "https") and address.host and 0 < port < 65536
    if not is_usable or "?" in url or "#" in url:
        raise ConfigError(
            f"{_without_user(url)!r} is not the address of a server: write an address such as "
            "http://127.0.0.1:8000/v1."
        )
    if address.userinfo:
        raise ConfigError(
            f"{_without_user(url)!r} contains a user name or password, which every saved "
            "configuration would show: put the API key into an environment variable and set "
            "vlm_labeller.http.api_key_variable to the variable's name."
        )
    return address


def _without_user(url: str) -> str:
    """Return an address without user and password."""
    before, at, after = url.partition("@")
    return f"{before.partition('://')[0]}://...@{after}" if at else url


def _key(variable: str) -> dict[str, str]:
    """Return the HTTP header with the API key from an environment variable.

    The result is empty if `variable` is empty.

    Raises:
        ConfigError: If the environment variable has no usable key.
    """
    if not variable:
        return {}
    key = os.environ.get(variable, "").strip()
    if not key or not key.isascii() or not key.isprintable():
        raise ConfigError(
            f"the environment variable {variable} has no usable API key: set the variable where "
            "the service is started, or leave vlm_labeller.http.api_key_variable empty."
        )
    return {"Authorization": f"Bearer {key}"}
