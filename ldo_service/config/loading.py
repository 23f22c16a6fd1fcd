"""Loading and validation of configurations: defaults, YAML files and single settings."""

import dataclasses
import os
import re
import typing
from collections.abc import Mapping, Sequence
from math import isnan
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import yaml

from ldo_service.errors import ConfigError, did_you_mean
from ldo_service.storage.yaml_io import dump_yaml, load_yaml

from .moved_settings import refuse_moved, was_section
from .sections import Config

PRESETS = Path(__file__).parent / "presets"
PRESET = "preset"  # Name that selects a preset where a setting may stand.
KINDS = {
    "int": "a whole number",
    "float": "a number",
    "bool": "true or false",
    "str": "text",
    "array": "a list",
    "object": "a section",
}


def load_config(
    path: Path | None = None,
    settings: Sequence[str] = (),
    values: Mapping[str, object] | None = None,
) -> Config:
    """Return the defaults, changed by a preset, then by a YAML file and then by single settings.

    Args:
        path: The YAML file; None for no file.
        settings: Settings as `section.field=value`, as on the command line. `preset=NAME` selects a
            preset, at any position in the list.
        values: Values of settings by dotted name, such as `{"mapper.iterations": 7}`. The key
            `preset` selects a preset.

    Raises:
        ConfigError: The preset does not exist. Or a setting cannot be read, is unknown, belongs to
            an earlier version, or has an invalid value.
    """
    values = dict(values or {})
    presets: list[object] = [s.partition("=")[2].strip() for s in settings if _is_preset(s)]
    if PRESET in values:
        presets.append(values.pop(PRESET))
    tree: dict[str, Any] = {}
    for name in presets:
        _merge(tree, _preset(name))
    if path:
        _merge(tree, _read(path))
    for setting in settings:
        if not _is_preset(setting):
            _apply(tree, setting)
    for name, value in values.items():
        _put(tree, name, _plain(value), name)
    return config_of(tree)


def config_of(tree: dict[str, Any]) -> Config:
    """Return the defaults, changed by a nested dictionary of settings.

    Raises:
        ConfigError: A setting is unknown, belongs to an earlier version, or has an invalid value.
    """
    refuse_moved(tree)
    _check_names(tree, Config, "")
    _refuse_nan(tree, "")
    try:
        return msgspec.convert(tree, Config)
    except msgspec.ValidationError as error:
        raise ConfigError(_explained(str(error), tree)) from error


def checked(config: Config) -> Config:
    """Validate all values of a configuration and return it.

    `dataclasses.replace` does not validate the values that it sets.

    Raises:
        ConfigError: A setting has an invalid value.
    """
    return config_of(msgspec.to_builtins(config))


# --- reading --------------------------------------------------------------------------------------
def _read(path: Path) -> dict[str, Any]:
    try:
        tree = load_yaml(path.read_text())
    except OSError as error:
        raise ConfigError(
            f"{path} cannot be read: {error.strerror}. Give an existing YAML file."
        ) from error
    except UnicodeDecodeError as error:
        raise ConfigError(
            f"{path} is not a text file in UTF-8. Give a YAML file in this encoding."
        ) from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}. Correct the file.") from error
    if not isinstance(tree or {}, dict):
        raise ConfigError(
            f"{path} must contain sections such as `tracker:`. `ldo config --all` prints all "
            "sections."
        )
    return tree or {}


def known_presets() -> dict[str, str]:
    """Return a description for the name of each preset: the first line of the preset's file."""
    return {
        path.stem: path.read_text().partition("\n")[0].removeprefix("#").strip()
        for path in sorted(PRESETS.glob("*.yaml"))
    }


def _is_preset(setting: str) -> bool:
    return setting.partition("=")[0].strip() == PRESET


def _preset(name: object) -> dict[str, Any]:
    """Return the settings of a preset.

    Raises:
        ConfigError: There is no such preset.
    """
    presets = known_presets()
    if not isinstance(name, str) or name not in presets:
        known = f"Known: {', '.join(presets)}."
        hint = did_you_mean(str(name), presets, known)
        raise ConfigError(f"preset={name} must be the name of a preset. {hint}")
    return _read(PRESETS / f"{name}.yaml")


def _merge(tree: dict[str, Any], changes: dict[str, Any]) -> None:
    """Change a tree of settings in place; sections are merged, values are replaced."""
    for name, value in changes.items():
        if isinstance(value, dict) and isinstance(tree.get(name), dict):
            _merge(tree[name], value)
        else:
            tree[name] = value


def _apply(tree: dict[str, Any], setting: str) -> None:
    name, equals, value = setting.partition("=")
    if not equals or "." not in name:
        raise ConfigError(f"--set {setting}: write the setting as section.field=value.")
    try:
        plain = load_yaml(value)
    except yaml.YAMLError as error:
        raise ConfigError(
            f"--set {setting}: the value is not valid YAML: {error}. Put a text with special "
            "characters into quotes."
        ) from error
    _put(tree, name.strip(), plain, f"--set {setting}")


def _put(tree: dict[str, Any], name: str, value: object, shown: str) -> None:
    """Set the value with a dotted name in a tree; `shown` names the setting in an error."""
    if not isinstance(name, str):
        raise ConfigError(
            f"the name of a setting is {name!r}, expected a text such as section.field."
        )
    *sections, last = name.split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise ConfigError(
                f"{shown}: {section} is a setting, not a section. `ldo config --all` lists the "
                "settings."
            )
    tree[last] = value


def _plain(value: object) -> object:
    """Return a value with paths as text and NumPy scalars as numbers."""
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.item() if isinstance(value, np.generic) else value


# --- checking -------------------------------------------------------------------------------------
def _check_names(tree: Any, schema: type, prefix: str) -> None:
    if not isinstance(tree, dict):
        return  # The conversion below reports the expected type.
    types = typing.get_type_hints(schema)
    for name, value in tree.items():
        path = f"{prefix}{name}"
        if name not in types:
            raise ConfigError(f"there is no setting {path}. {_hint(path, prefix, list(types))}")
        if dataclasses.is_dataclass(types[name]):
            _check_names(value, types[name], f"{path}.")


def _hint(path: str, prefix: str, names: list[str]) -> str:
    if path == PRESET:
        return (
            "A file cannot select a preset: use --preset NAME, or settings={'preset': NAME} in "
            "Python."
        )
    if was_section(path):
        return "Its settings have moved: docs/configuration.md lists the current settings."
    known = f"Known: {', '.join(names)}."
    return did_you_mean(path.removeprefix(prefix), names, known, prefix)


def _refuse_nan(tree: dict[str, Any], prefix: str) -> None:
    """Check that no number is NaN, which would pass every comparison.

    Raises:
        ConfigError: A number is NaN.
    """
    for name, value in tree.items():
        path = f"{prefix}{name}"
        if isinstance(value, dict):
            _refuse_nan(value, f"{path}.")
        elif any(isinstance(one, float) and isnan(one) for one in _items(value)):
            raise ConfigError(f"{path}={_shown(value)} must be a number, not NaN.")


def _items(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


# --- messages -------------------------------------------------------------------------------------
_PLACE = re.compile(r"^(?P<what>.*?)(?: - at `\$\.?(?P<path>[^\[`]*)(?:\[(?P<item>\d+)\])?.*`)?$")
_BOUND = re.compile(r"^Expected `\w+` (?P<sign>[<>]=?) (?P<bound>\S+)$")
_LENGTH = re.compile(r"^Expected `array` of length (?P<at_least>>= )?(?P<length>\d+)")
_KIND = re.compile(r"^Expected `(?P<kind>\w+)`")
_SIGNS = {">=": "at least", ">": "greater than", "<=": "at most", "<": "less than"}


def _explained(message: str, tree: dict[str, Any]) -> str:
    """Return the message of a failed conversion with the path and the value of the setting."""
    found = _PLACE.match(message)
    if not found or not found["path"]:
        return message
    path, item = found["path"], found["item"]
    where = f"{path}={_shown(_value_at(tree, path))}"
    wanted = _wanted(found["what"], path)
    if item is not None:
        return f"{where} must be {wanted} in item {int(item) + 1}."
    return f"{where} must be {wanted}."


def _wanted(what: str, path: str) -> str:
    if what.startswith("Invalid enum value"):
        return f"one of {', '.join(repr(choice) for choice in _choices(path))}"
    if found := _BOUND.match(what):
        if found["sign"] == ">" and float(found["bound"]) == 0:
            return "positive"
        return f"{_SIGNS[found['sign']]} {float(found['bound']):g}"
    if found := _LENGTH.match(what):
        least = "at least " if found["at_least"] else ""
        return f"a list of {least}{found['length']}"
    if found := _KIND.match(what):
        return KINDS.get(found["kind"], found["kind"])
    return what.lower()


def _value_at(tree: dict[str, Any], path: str) -> Any:
    value: Any = tree
    for name in path.split("."):
        value = value[name]
    return value


def _choices(path: str) -> tuple[str, ...]:
    schema: Any = Config
    for name in path.split("."):
        schema = typing.get_type_hints(schema)[name]
    if typing.get_origin(schema) is tuple:  # Choices of the items.
        schema, *_ = typing.get_args(schema)
    return typing.get_args(schema)


def _shown(value: Any) -> str:
    if isinstance(value, str):
        return value
    if isinstance(value, float):
        return f"{value:g}"
    return " ".join(dump_yaml(value, flow=True, width=float("inf")).removesuffix("...\n").split())
