"""Settings of earlier versions, and where each of them is now."""

import functools
from importlib.resources import files
from typing import Any

from ldo_service.errors import ConfigError

SHOWN = 5  # An old configuration file has hundreds of them.


def refuse_moved(tree: dict[str, Any]) -> None:
    """Refuse settings that have another name now, or are constants.

    Args:
        tree: The plain values of a file or of the command line.

    Raises:
        ConfigError: A setting of an earlier version is among them; the message has its new name.
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
    """Return a sentence that says where a setting is now; empty for one that has not moved."""
    kind, new = _table().get(path, ("", ""))
    if kind == "setting":
        return f"{path} is now {new}."
    if kind == "constant":
        return f"{path} is a constant now: {new}."
    return ""


def was_section(path: str) -> bool:
    """Return whether earlier versions had a section of this name."""
    return any(old.startswith(f"{path}.") for old in _table())


@functools.cache
def _table() -> dict[str, tuple[str, str]]:
    """Return the kind and the new place of each old path."""
    text = files("ldo_service.config").joinpath("moved_settings.tsv").read_text()
    rows = [line.split("\t") for line in text.splitlines()[1:]]
    return {old: (kind, new) for old, kind, new in rows}


def _leaves(tree: dict[str, Any], prefix: str) -> list[str]:
    paths: list[str] = []
    for name, value in tree.items():
        path = f"{prefix}{name}"
        paths += _leaves(value, f"{path}.") if isinstance(value, dict) else [path]
    return paths
