"""Errors of the package and the exit codes of the command line.

    LdoError                      1
    ├── ConfigError               2
    │   ├── LosslessCycle
    │   ├── ModelError
    │   └── EndpointError
    ├── DataError                 3
    │   └── FrameError
    ├── StageError                4
    │   ├── RestartsExhausted
    │   └── StageStalled
    └── ReplayDiverged            5

Every message is one paragraph: the problem, its place, and what to do next. Expected outcomes of an
algorithm (tracking lost, a rejected loop closure) are values in messages, not errors.
"""

from collections.abc import Iterable
from difflib import get_close_matches


class LdoError(Exception):
    """Base class of all errors of the package."""

    exit_code = 1


class ConfigError(LdoError):
    """Invalid arguments, configuration or environment."""

    exit_code = 2


class LosslessCycle(ConfigError):
    """Cycle of lossless inputs in which each actor could wait for the next."""

    def __init__(self, path: list[str]) -> None:
        super().__init__(
            f"lossless cycle {' -> '.join(path)}: each actor could wait for credit of the next "
            "forever. Make one of these inputs Latest."
        )
        self.path = path


class EndpointError(ConfigError):
    """Server that does not reply or sends an invalid reply."""


class ModelError(ConfigError):
    """Network that has the wrong format or fails."""


class DataError(LdoError):
    """Unreadable data, invalid calibration, or too many invalid frames."""

    exit_code = 3


class FrameError(DataError):
    """Single unreadable frame, which is skipped and counted; the log has the first one."""


class StageError(LdoError):
    """Actor that cannot be restarted any more."""

    exit_code = 4


class RestartsExhausted(StageError):
    """Actor that failed more often than its restart budget allows."""

    def __init__(self, actor: str, restarts: int, window_s: float) -> None:
        super().__init__(
            f"{actor} failed {restarts} times within {window_s:g} s, so the service stops. The log "
            "above has each failure. Fix its cause, or raise supervision.max_restarts."
        )
        self.actor, self.restarts, self.window_s = actor, restarts, window_s


class StageStalled(StageError):
    """Step that exceeds its time limit."""

    def __init__(self, actor: str, age_s: float) -> None:
        super().__init__(
            f"{actor} has been busy with one message for {age_s:.0f} s and cannot be interrupted. "
            "Reduce its work per message, or raise supervision.step_timeout_s."
        )
        self.actor, self.age_s = actor, age_s


class ReplayDiverged(LdoError):
    """Difference between a recorded step and its replay."""

    exit_code = 5

    def __init__(self, actor: str, step: str, what: str, recorded: str, replayed: str) -> None:
        super().__init__(
            f"{actor} diverged at {step}: {what} was {recorded} when recorded and is {replayed} "
            "now. The recording, the code, a library or the instruction set has changed, or the "
            "actor uses an input that is not recorded, such as a clock."
        )
        self.actor, self.step, self.what = actor, step, what
        self.recorded, self.replayed = recorded, replayed


def named(parameters: object, *fields: str) -> str:
    """Return fields of a parameter object with their values, as the beginning of an error.

    Args:
        parameters: An instance of a dataclass such as `ViewSamplingConfig`.
        fields: Names of the fields that the error is about.
    """
    owner = type(parameters).__name__
    return ", ".join(f"{owner}.{field}={getattr(parameters, field)!r}" for field in fields)


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """Return a sentence with a suggestion for an unknown name.

    Args:
        name: The unknown name.
        known: The known names.
        otherwise: The sentence if no known name is similar.
        prefix: Text before the suggested name, such as the path of its section.
    """
    near = get_close_matches(name, known, 1)
    return f"Did you mean {prefix}{near[0]}?" if near else otherwise
