"""Errors of the package and the exit codes of the command line.

    LdoError                      1
    ├── ConfigError               2
    │   ├── LosslessCycle
    │   ├── ModelError
    │   ├── EndpointError
    │   └── UnavailableError      6
    ├── DataError                 3
    │   ├── FrameError
    │   └── DamagedStateError
    ├── DeviceError
    ├── StageError                4
    │   ├── RestartsExhausted
    │   └── StageStalled
    └── ReplayDiverged            5

The number is the exit code; a class without a number has that of its base class. Every error text
is one paragraph: the problem, where it is, and what to do next. Expected outcomes of an algorithm,
such as lost tracking or a rejected loop closure, are values in messages between actors, not errors.
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
    """Cycle of lossless inputs in a graph of actors; all actors of the cycle could deadlock.

    A lossless input makes the sending actor wait for the receiving actor.
    """

    def __init__(self, path: list[str]) -> None:
        super().__init__(
            f"lossless cycle {' -> '.join(path)}: each actor could wait forever for credit from "
            "the next one. Change one of these inputs to the policy Latest."
        )
        self.path = path


class EndpointError(ConfigError):
    """Failed request to an HTTP server, such as a labeller: no reply or an invalid reply."""


class UnavailableError(ConfigError):
    """Network port, Zenoh router or state folder that cannot be used now, but perhaps later."""

    exit_code = 6


class ModelError(ConfigError):
    """Neural network file that has the wrong format, or whose inference fails."""


class DeviceError(LdoError):
    """Compute device, such as a GPU, that is missing, fails, lacks memory or gives wrong results.

    The service continues on the CPU; `ldo bench` stops.
    """


class DataError(LdoError):
    """Unreadable data, invalid calibration, or too many invalid frames."""

    exit_code = 3


class FrameError(DataError):
    """Single unusable frame; callers skip and count such frames, and log the first one."""


class DamagedStateError(DataError):
    """Saved state of an actor that is incomplete or does not match its checksums."""


class StageError(LdoError):
    """Failure of an actor after which the service stops instead of restarting the actor."""

    exit_code = 4


class RestartsExhausted(StageError):
    """Too many failures of an actor: more than `supervision.max_restarts` allows."""

    def __init__(self, actor: str, restarts: int, window_s: float) -> None:
        super().__init__(
            f"{actor} failed {restarts} times within {window_s:g} s, so the service stops. The log "
            "above has each failure. Fix the cause, or raise supervision.max_restarts."
        )
        self.actor, self.restarts, self.window_s = actor, restarts, window_s


class StageStalled(StageError):
    """Step of an actor that exceeds its time limit; a step is the handling of one message."""

    def __init__(self, actor: str, age_s: float, setting: str) -> None:
        super().__init__(
            f"{actor} has been busy with one message for {age_s:.0f} s and cannot be interrupted. "
            f"Reduce its work per message, or raise {setting}."
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
    """Format fields of a parameter object with their values, as the beginning of an error text.

    Example: `ViewSamplingConfig.count=0`.

    Args:
        parameters: An instance of a dataclass such as `ViewSamplingConfig`.
        fields: Names of the fields that the error is about.
    """
    owner = type(parameters).__name__
    return ", ".join(f"{owner}.{field}={getattr(parameters, field)!r}" for field in fields)


def install_command(extra: str) -> str:
    """Return the pip command that installs an optional extra of the package, for an error text."""
    return f"`.venv/bin/pip install -e '.[{extra}]'` in the clone of LDO-SLAM"


def did_you_mean(name: str, known: Iterable[str], otherwise: str, prefix: str = "") -> str:
    """Return a sentence that suggests the known name most similar to an unknown name.

    Args:
        name: The unknown name.
        known: The known names.
        otherwise: The sentence to return if no known name is similar.
        prefix: Text before the suggested name, such as the configuration section `mapper.`.
    """
    near = get_close_matches(name, known, 1)
    return f"Did you mean {prefix}{near[0]}?" if near else otherwise
