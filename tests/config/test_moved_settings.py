"""Settings of earlier versions, each refused with its new name or its constant."""

import dataclasses
import importlib
from importlib.resources import files
from pathlib import Path

import pytest

from ldo_service.config import Config, config_of, load_config
from ldo_service.config.printing import settings_of
from ldo_service.errors import ConfigError
from tests.config.test_settings import tree_of

TABLE = files("ldo_service.config").joinpath("moved_settings.tsv").read_text()
ROWS = [tuple(line.split("\t")) for line in TABLE.splitlines()[1:]]
PATHS = {setting.path for setting in settings_of(Config())}
SETTABLE_BEFORE = 513
UNCHANGED = 17
RENAMED_TWICE = 2  # Settings whose second name is in the table too.


def test_every_earlier_setting_is_in_the_table_or_unchanged() -> None:
    assert (
        len({old for old, _, _ in ROWS}) == len(ROWS) == SETTABLE_BEFORE - UNCHANGED + RENAMED_TWICE
    )
    assert PATHS.isdisjoint(old for old, _, _ in ROWS)


@pytest.mark.parametrize(("old", "kind", "new"), ROWS, ids=[row[0] for row in ROWS])
def test_moved_setting_is_refused_with_its_new_name(old: str, kind: str, new: str) -> None:
    expected = f"{old} is now {new}." if kind == "setting" else f"{old} is a constant now: {new}."
    with pytest.raises(ConfigError) as raised:
        load_config(settings=[f"{old}=1"])
    assert str(raised.value).startswith(expected)
    with pytest.raises(ConfigError) as raised:
        config_of(tree_of(old, [1, 2]))
    assert str(raised.value).startswith(expected)


@pytest.mark.parametrize(("old", "kind", "new"), ROWS, ids=[row[0] for row in ROWS])
def test_new_name_exists(old: str, kind: str, new: str) -> None:
    if kind == "setting":
        assert new in PATHS
        return
    holder, name = new.rsplit(".", 1)
    module, _, owner = holder.rpartition(".")
    if not owner[0].isupper():
        assert hasattr(importlib.import_module(holder), name), old
        return
    fields = dataclasses.fields(getattr(importlib.import_module(module), owner))
    assert name in {entry.name for entry in fields}, old


def test_file_of_moved_settings_is_refused_in_a_few_lines(tmp_path: Path) -> None:
    path = tmp_path / "config.yaml"
    path.write_text(
        "frame_source: {max_skew_s: 0.015, pair_buffer: 8, min_side_px: 32}\n"
        "tracker:\n  odometry:\n    pyramid: {working_width_px: 320, levels: 4}\n"
        "stage: {nice: 10, heartbeat_s: 0.5, stall_after_s: 60.0}\n"
    )
    with pytest.raises(ConfigError) as raised:
        load_config(path)
    message = str(raised.value)
    assert "tracker.odometry.pyramid.working_width_px is now tracker.image.width_px." in message
    assert "And 2 more settings have moved." in message
    assert len(message) < 800


@pytest.mark.parametrize("section", ["stage", "tracker.odometry", "mapper.builder"])
def test_moved_section_is_refused_with_a_link_to_the_documentation(section: str) -> None:
    with pytest.raises(ConfigError, match="Its settings have moved: docs/configuration"):
        config_of(tree_of(section, None))
