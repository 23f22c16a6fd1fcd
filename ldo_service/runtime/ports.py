"""Ports of an actor. The delivery policy belongs to the input: only a consumer knows whether a
late message is still worth something."""

from dataclasses import dataclass

from ldo_service.errors import ConfigError
from ldo_service.schemas.topics import Topic


@dataclass(frozen=True, slots=True)
class Lossless:
    """Every message arrives, in order; the producer waits for room."""

    window: int = 8  # messages that may be under way; bounds memory at both ends

    def __post_init__(self) -> None:
        if self.window < 1:
            raise ConfigError(f"Lossless(window={self.window}): must be at least 1.")

    def __str__(self) -> str:
        return f"Lossless({self.window})"


@dataclass(frozen=True, slots=True)
class Latest:
    """The newest `keep` messages wait; older ones are dropped and counted.

    With `per_key`, the newest `keep` for each value of the topic's key, at most `max_keys` values:
    the oldest value makes room for a new one.
    """

    keep: int = 1
    per_key: bool = False
    max_keys: int = 32

    def __post_init__(self) -> None:
        if self.keep < 1 or self.max_keys < 1:
            raise ConfigError(
                f"Latest(keep={self.keep}, max_keys={self.max_keys}): both must be at least 1."
            )

    def __str__(self) -> str:
        return f"Latest({self.keep} per key)" if self.per_key else f"Latest({self.keep})"


Policy = Lossless | Latest


@dataclass(frozen=True, slots=True)
class In:
    """`goes_first`: what comes here is taken before all that waits at other inputs."""

    topic: Topic
    policy: Policy
    goes_first: bool = False

    def __post_init__(self) -> None:
        if isinstance(self.policy, Latest) and self.policy.per_key and self.topic.key is None:
            raise ConfigError(f"{self.topic.name} has no key: Latest(per_key=True) cannot be used.")


@dataclass(frozen=True, slots=True)
class Out:
    """`never_wait`: the actor looks at `room` before it makes a message, and never waits for it."""

    topic: Topic
    never_wait: bool = False
