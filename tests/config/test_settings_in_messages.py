"""Every setting that a text of the package names exists in the configuration."""

import ast
import dataclasses
import re
from collections.abc import Iterator
from pathlib import Path

from ldo_service.config import Config

ROOT = Path(__file__).parents[2]
FOLDERS = "actors", "schemas", "ldo_service"
SECTIONS = [field.name for field in dataclasses.fields(Config)]
NAME = re.compile(rf"(?<![\w./-])(?:{'|'.join(SECTIONS)})(?:\.[A-Za-z_]+)+(?![\w/(-])")
NO_SETTINGS = re.compile(r"\.(py|yaml|md|json|mcap|onnx|config)$")


def texts(path: Path) -> Iterator[str]:
    """Yield the parts of all strings in a module except docstrings."""
    tree = ast.parse(path.read_text())
    docstrings = {
        id(node.value)
        for node in ast.walk(tree)
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)
    }
    for node in ast.walk(tree):
        is_text = isinstance(node, ast.Constant) and isinstance(node.value, str)
        if is_text and id(node) not in docstrings:
            yield node.value


def exists(setting: str) -> bool:
    """Return whether a dotted path leads to a setting or a section of the configuration."""
    value: object = Config()
    for name in setting.split("."):
        if not dataclasses.is_dataclass(value) or not hasattr(value, name):
            return False
        value = getattr(value, name)
    return True


def test_texts_name_settings_that_exist() -> None:
    named = {
        (setting, path.relative_to(ROOT).as_posix())
        for folder in FOLDERS
        for path in sorted((ROOT / folder).rglob("*.py"))
        for text in texts(path)
        for setting in NAME.findall(text)
        if not NO_SETTINGS.search(setting)
    }
    assert len(named) > 50
    assert sorted(one for one in named if not exists(one[0])) == []
