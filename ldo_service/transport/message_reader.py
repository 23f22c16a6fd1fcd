"""Reader of the service's topics, for programs outside the service."""

import logging
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import msgspec
import zenoh

from ldo_service.errors import ConfigError
from ldo_service.schemas import Message, decode
from ldo_service.schemas.topics import Topic

from .endpoint import Endpoint
from .flow_control import ALIVE, Header, SequenceTracker

M = TypeVar("M", bound=Message)
log = logging.getLogger(__name__)


class MessageReader:
    """Subscribers and queries of one program outside the service.

    A subscriber buffers the newest messages and drops older ones. It therefore slows no producer.
    """

    def __init__(self, session: zenoh.Session, network: Endpoint) -> None:
        self._session, self._network = session, network

    def messages(self, topic: Topic, keep: int) -> Iterator[tuple[Header, Message]]:
        """Yield header and message of each sample on a topic; the iteration never ends.

        Messages that a restarted producer repeats are skipped. Samples without a header and
        malformed messages, which other programs may put on a topic, are skipped too. If messages
        arrive faster than the caller takes them, only the newest `keep` are buffered.
        """
        numbers = SequenceTracker()
        with self._subscriber(topic.subscription_key, keep) as subscriber:
            for sample in subscriber:
                header = _header_of(sample)
                if header is not None and numbers.observe(header):
                    for message in _readable((sample,), topic.message):
                        yield header, message

    @contextmanager
    def poller(self, key: str, kind: type[M], keep: int) -> Iterator[Callable[[], list[M]]]:
        """Open a context with a function that returns the messages received since its last call.

        The function returns immediately, even if there are no messages.

        Args:
            key: Key of the messages, relative to the key prefix of the robot; it may contain `*`.
            kind: Type of the messages; malformed messages are logged and skipped.
            keep: Maximum number of buffered messages; the oldest ones are dropped.
        """
        with self._subscriber(key, keep) as subscriber:

            def inbox() -> list[M]:
                return list(_readable(iter(subscriber.try_recv, None), kind))

            yield inbox

    def last_values(self, topic: Topic, timeout_s: float) -> list[Message]:
        """Return all messages of the last value of a state topic; empty if there is no value.

        A state topic answers queries with its last value, which may consist of several messages.
        """
        replies = self._session.get(
            self._network.expression(topic.name),
            timeout=timeout_s,
            consolidation=zenoh.ConsolidationMode.NONE,  # Other modes return only one part.
        )
        return list(_readable((r.ok for r in replies if r.ok is not None), topic.message))

    def request(
        self, topic: Topic, message: Message, answer: type[M], timeout_s: float
    ) -> M | None:
        """Send a request; return the answer, or None if none arrives within `timeout_s`.

        Raises:
            ConfigError: The answer is malformed.
        """
        replies = self._session.get(
            self._network.expression(topic.name),
            payload=msgspec.msgpack.encode(message),
            timeout=timeout_s,
        )
        for reply in replies:
            if reply.ok is not None:
                try:
                    return _message_of(reply.ok, answer)
                except msgspec.DecodeError as error:
                    raise ConfigError(
                        f"the service answered on {topic.name} with a malformed "
                        f"{answer.__name__}: {error}. Check that the service has the same version "
                        "as this program."
                    ) from error
        return None

    def live_actors(self, timeout_s: float) -> set[str]:
        """Return the names of the actors with a running process."""
        expression = self._network.expression(f"{ALIVE}/*")
        replies = self._session.liveliness().get(expression, timeout=timeout_s)
        return {str(r.ok.key_expr).rsplit("/", 1)[1] for r in replies if r.ok is not None}

    def _subscriber(self, key: str, keep: int) -> Any:
        ring = zenoh.handlers.RingChannel(keep)
        return self._session.declare_subscriber(self._network.expression(key), ring)


def _header_of(sample: Any) -> Header | None:
    """Return the header of a sample; None if it has none or a malformed one."""
    if sample.attachment is None:
        return None
    try:
        return decode(sample.attachment.to_bytes(), Header)
    except msgspec.DecodeError:
        return None


def _message_of(sample: Any, kind: type[M]) -> M:
    return decode(sample.payload.to_bytes(), kind)


def _readable(samples: Iterable[Any], kind: type[M]) -> Iterator[M]:
    """Yield the messages of samples; malformed ones are logged and skipped."""
    for sample in samples:
        try:
            yield _message_of(sample, kind)
        except msgspec.DecodeError as error:
            log.warning(
                "client: malformed %s skipped: %s. Check that the service has the same version as "
                "this program.",
                kind.__name__, error,
            )  # fmt: skip
