"""Printing of configurations, with a comment on each setting."""

import dataclasses
import inspect
import re
from collections.abc import Iterator
from dataclasses import dataclass
from math import inf
from typing import Any

import msgspec

from ldo_service.storage.yaml_io import dump_yaml

from .sections import Config
from .values import ADVANCED


@dataclass(frozen=True, slots=True)
class Setting:
    """Setting of a configuration: its path, its value and the comment that explains it."""

    path: str  # Names of the sections and the field, joined by dots.
    value: Any
    text: str  # The value as YAML.
    comment: str
    is_public: bool  # False for an advanced setting.


def config_yaml(config: Config) -> str:
    """Return the whole configuration as YAML that can be loaded again."""
    return dump_yaml(msgspec.to_builtins(config))


def explained_yaml(config: Config, *, with_advanced: bool = False) -> str:
    """Return the configuration as YAML with comments.

    Loading the text gives the same configuration.

    Args:
        config: The configuration.
        with_advanced: True prints all settings, as `ldo config --all` does. False omits advanced
            settings that have their defaults.
    """
    defaults = {setting.path: setting.value for setting in settings_of(Config())}
    lines: list[str] = []
    opened: list[str] = []
    for setting in settings_of(config):
        is_default = setting.value == defaults[setting.path]
        if not (setting.is_public or with_advanced) and is_default:
            continue
        *sections, name = setting.path.split(".")
        for depth, section in enumerate(sections):
            if opened[depth : depth + 1] != [section]:
                opened = [*sections[: depth + 1]]
                lines.append(f"{'  ' * depth}{section}:")
        opened = sections
        lines.append(f"{'  ' * len(sections)}{name}: {setting.text}  # {setting.comment}")
    return "\n".join(lines) + "\n"


def settings_of(config: Config) -> list[Setting]:
    """Return all settings in the order of the sections."""
    return list(_settings(config, ""))


def section_titles() -> dict[str, str]:
    """Return the first sentence of each section's docstring, by the path of the section."""
    return dict(_titles(Config(), ""))


def _settings(section: Any, prefix: str) -> Iterator[Setting]:
    comments = _comments(type(section))
    for entry in dataclasses.fields(section):
        path, value = f"{prefix}{entry.name}", getattr(section, entry.name)
        if dataclasses.is_dataclass(value):
            yield from _settings(value, f"{path}.")
        else:
            plain = msgspec.to_builtins(value)
            text = dump_yaml(plain, flow=True, width=inf).splitlines()[0]
            comment = comments.get(entry.name, "")
            yield Setting(path, value, text, comment, ADVANCED not in entry.metadata)


def _titles(section: Any, prefix: str) -> Iterator[tuple[str, str]]:
    for entry in dataclasses.fields(section):
        path, value = f"{prefix}{entry.name}", getattr(section, entry.name)
        if dataclasses.is_dataclass(value):
            text = " ".join((inspect.getdoc(type(value)) or "").split())
            yield path, re.split(r"(?<=\.) ", text)[0]
            yield from _titles(value, f"{path}.")


_FIELD = re.compile(r"^ {4}(?P<name>\w+): [^#]*(?:#\s*(?P<comment>.*))?$")
_COMMENT = re.compile(r"^ {4,}# (?P<comment>.+)$")


def _comments(schema: type) -> dict[str, str]:
    """Return the comment of each field in the source of a dataclass.

    A comment starts on the line of the field and continues on the lines below. A field without a
    comment on its line takes the comment lines above it, if they begin with a capital letter.
    """
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
