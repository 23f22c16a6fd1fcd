"""Rejection of settings of earlier versions; the error gives their current names."""

import functools
from importlib.resources import files
from typing import Any

from ldo_service.errors import ConfigError

SHOWN = 5  # Maximum number of moved settings in one message; an old file has hundreds.


def refuse_moved(tree: dict[str, Any]) -> None:
    """Check that no setting has been renamed or is now a constant.

    Args:
        tree: Nested dictionary of the settings in a file or on the command line.

    Raises:
        ConfigError: A setting belongs to an earlier version. The message gives the new name of the
            setting, or the constant that replaces it.
    """
    refusals = [text for path in _leaves(tree, "") if (text := moved(path))]
    if not refusals:
        return
    rest = (
        f" And {len(refusals) - SHOWN} more settings have moved." if len(refusals) > SHOWN else ""
    )
    raise ConfigError(
        f"{' '.join(refusals[:SHOWN])}{rest} docs/configuration.md and `ldo config --all` list the "
        "settings."
    )


def moved(path: str) -> str:
    """Return a sentence that gives the new name of a setting, or the constant that replaces it.

    Args:
        path: Path of a setting in this or an earlier version, such as `stage.nice`.

    Returns:
        The sentence; empty if the setting has not moved.
    """
    kind, new = _table().get(path, ("", ""))
    if kind == "setting":
        return f"{path} is now {new}."
    if kind == "constant":
        return f"{path} is a constant now: {new}."
    return ""


def was_section(path: str) -> bool:
    """Return whether an earlier version had a section of this name."""
    return any(old.startswith(f"{path}.") for old in _table())


@functools.cache
def _table() -> dict[str, tuple[str, str]]:
    """Return the kind ("setting" or "constant") and the new name of each setting, by old path."""
    text = files("ldo_service.config").joinpath("moved_settings.tsv").read_text()
    rows = [line.split("\t") for line in text.splitlines()[1:]]
    return {old: (kind, new) for old, kind, new in rows}


def _leaves(tree: dict[str, Any], prefix: str) -> list[str]:
    paths: list[str] = []
    for name, value in tree.items():
        path = f"{prefix}{name}"
        paths += _leaves(value, f"{path}.") if isinstance(value, dict) else [path]
    return paths
