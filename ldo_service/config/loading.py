"""Reading, checking and explaining of configurations: defaults, YAML files and single settings."""

import dataclasses
import difflib
import inspect
import re
import typing
from collections.abc import Sequence
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import yaml

from ldo_service.errors import ConfigError
from ldo_service.storage.yaml_io import plain_text, plain_values

from .sections import Config


def load_config(path: Path | None = None, settings: Sequence[str] = ()) -> Config:
    """The defaults, changed by a YAML file, changed by `section.field=value` settings.

    Raises ConfigError for what cannot be read, is not known, or makes no sense.
    """
    tree = _read(path) if path else {}
    for setting in settings:
        _apply(tree, setting)
    return config_of(tree)


def config_of(tree: dict[str, Any]) -> Config:
    """The defaults, changed by a tree of plain values."""
    _check_names(tree, Config, "")
    try:
        config = msgspec.convert(tree, Config)
        _refuse_nan(config, "")
        return config
    except msgspec.ValidationError as error:
        raise ConfigError(_without_path_sugar(str(error))) from error


def config_yaml(config: Config) -> str:
    """The whole configuration; reads back as the same."""
    return plain_text(msgspec.to_builtins(config))


def explained_yaml(config: Config) -> str:
    """The whole configuration with the reason for each default beside it."""
    return "\n".join(_explain(config, 0)) + "\n"


def _read(path: Path) -> dict[str, Any]:
    try:
        tree = plain_values(path.read_text())
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}.") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path} is no text in UTF-8.") from error
    except yaml.YAMLError as error:
        raise ConfigError(f"{path} is not valid YAML: {error}") from error
    if not isinstance(tree or {}, dict):
        raise ConfigError(f"{path} must hold sections such as `tracker:`, `ldo config` shows them.")
    return tree or {}


def _apply(tree: dict[str, Any], setting: str) -> None:
    name, equals, value = setting.partition("=")
    if not equals or "." not in name:
        raise ConfigError(f"--set {setting}: write it as section.field=value.")
    *sections, last = name.strip().split(".")
    for section in sections:
        tree = tree.setdefault(section, {})
        if not isinstance(tree, dict):
            raise ConfigError(f"--set {setting}: {section} is no section.")
    try:
        tree[last] = plain_values(value)
    except yaml.YAMLError as error:
        raise ConfigError(f"--set {setting}: the value is not valid YAML: {error}") from error


def _check_names(tree: Any, schema: type, prefix: str) -> None:
    if not isinstance(tree, dict):
        return  # the conversion says what was expected here
    types = typing.get_type_hints(schema)
    for name, value in tree.items():
        if name not in types:
            near = difflib.get_close_matches(str(name), types, 1)
            hint = f"Did you mean {prefix}{near[0]}?" if near else f"Known: {', '.join(types)}."
            raise ConfigError(f"there is no setting {prefix}{name}. {hint}")
        if dataclasses.is_dataclass(types[name]):
            _check_names(value, types[name], f"{prefix}{name}.")


def _refuse_nan(config: Any, prefix: str) -> None:
    """NaN passes every comparison that a section makes."""
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            _refuse_nan(value, f"{prefix}{entry.name}.")
        elif value != value or (isinstance(value, tuple) and any(v != v for v in value)):
            raise ConfigError(f"{prefix}{entry.name} is NaN: write a number.")


def _without_path_sugar(message: str) -> str:
    """msgspec ends with "- at `$.tracker.hold_out`": say it as the user wrote it."""
    return re.sub(r" - at `\$\.?(.*?)`$", r", in \1.", message)


_FIELD = re.compile(r"^ {4}(?P<name>\w+): [^#]*(?:#\s*(?P<comment>.*))?$")
_COMMENT = re.compile(r"^ {4,}# (?P<comment>.+)$")


def _explain(config: Any, depth: int) -> list[str]:
    comments = _comments(type(config))
    lines = []
    for entry in dataclasses.fields(config):
        value = getattr(config, entry.name)
        indent = "  " * depth
        if dataclasses.is_dataclass(value):
            lines += [f"{indent}{entry.name}:", *_explain(value, depth + 1)]
        else:
            plain = msgspec.to_builtins(value)
            text = plain_text(plain, flow=True, width=inf).splitlines()[0]
            comment = f"  # {comments[entry.name]}" if entry.name in comments else ""
            lines.append(f"{indent}{entry.name}: {text}{comment}")
    return lines or ["  " * depth + "{}"]


def _comments(schema: type) -> dict[str, str]:
    """The comment of each field in the source: beside it, with the lines that continue it, or, of
    one that has none beside it, the lines above it that begin a sentence."""
    comments: dict[str, list[str]] = {}
    last, block = "", list[str]()
    for line in inspect.getsource(schema).splitlines():
        if line.startswith(("    def ", "    @")):
            break
        if found := _FIELD.match(line):
            name, beside = found["name"], found["comment"]
            is_above = not beside and bool(block) and block[0][0].isupper()
            comments[name] = [beside] if beside else block if is_above else []
            comments.get(last, []).extend([] if is_above else block)
            last, block = name, []
        elif found := _COMMENT.match(line):
            block.append(found["comment"])
    comments.get(last, []).extend(block)
    return {name: " ".join(lines) for name, lines in comments.items() if lines}
