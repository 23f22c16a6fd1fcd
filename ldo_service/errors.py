"""What can go wrong, and what the command line makes of it.

    LdoError                      exit code 1
    ├── ConfigError               2   bad arguments or configuration
    │   ├── LosslessCycle             a graph of actors that could wait for itself
    │   ├── ModelError                a network that is not what it is taken for, or fails
    │   └── EndpointError             a server that does not answer, or not what it was asked
    ├── DataError                 3   nothing readable, broken calibration, too many bad frames
    │   └── FrameError                one frame cannot be read: skipped, counted, warned about once
    ├── StageError                4   a part of the service gave up
    │   ├── RestartsExhausted
    │   └── StageStalled
    └── ReplayDiverged            5   a replay produced something else than the recording

Every message is one paragraph: what, where, and what to do next. Outcomes that an algorithm
expects (tracking lost, a loop refused) are values in messages, not errors.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class LdoError(Exception):
    exit_code = 1


class ConfigError(LdoError):
    exit_code = 2


class LosslessCycle(ConfigError):
    def __init__(self, path: list[str]) -> None:
        super().__init__(
            f"lossless cycle {' -> '.join(path)}: each would wait for room at the next, for ever. "
            "Make one of these inputs Latest."
        )
        self.path = path


class EndpointError(ConfigError):
    pass


class ModelError(ConfigError):
    pass


class DataError(LdoError):
    exit_code = 3


class FrameError(DataError):
    pass


class StageError(LdoError):
    exit_code = 4


class RestartsExhausted(StageError):
    def __init__(self, actor: str, restarts: int, window_s: float) -> None:
        super().__init__(
            f"{actor} failed {restarts} times within {window_s:g} s and was given up. "
            "The log above has each failure; fix its cause, or raise supervision.max_restarts."
        )
        self.actor, self.restarts, self.window_s = actor, restarts, window_s


class StageStalled(StageError):
    def __init__(self, actor: str, age_s: float) -> None:
        super().__init__(
            f"{actor} has been busy with one message for {age_s:.0f} s and cannot be interrupted. "
            "Give it less work per message, or raise supervision.step_timeout_s."
        )
        self.actor, self.age_s = actor, age_s


class ReplayDiverged(LdoError):
    """`what` differs from `recorded` to `replayed` in a step of an actor."""

    exit_code = 5

    def __init__(self, actor: str, step: str, what: str, recorded: str, replayed: str) -> None:
        super().__init__(
            f"{actor} diverged at {step}: {what} was {recorded} when recorded and is {replayed} "
            "now. Either the recording was changed, or the code, a library or the instruction "
            "set, or the actor uses something that is not recorded, such as a clock."
        )
        self.actor, self.step, self.what = actor, step, what
        self.recorded, self.replayed = recorded, replayed


def named(parameters: object, *fields: str) -> str:
    """Return fields of a parameter object with their values, to begin an error with.

    Args:
        parameters: An instance of a dataclass such as `ViewSamplingConfig`.
        fields: Names of the fields that the error is about.
    """
    owner = type(parameters).__name__
    return ", ".join(f"{owner}.{field}={getattr(parameters, field)!r}" for field in fields)


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """Return the sentence that ends the refusal of an unknown name.

    Args:
        name: What was written.
        known: The names that exist.
        otherwise: The sentence if none of these is near.
        prefix: What stands before the name that is suggested, such as the path of its section.
    """
    near = get_close_matches(name, known, 1)
    return f"Did you mean {prefix}{near[0]}?" if near else otherwise
