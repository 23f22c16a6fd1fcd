"""Properties of all settings: number, comments, errors and effect."""

import re
from math import inf, nan
from pathlib import Path
from typing import Any

import pytest

import ldo_service
from ldo_service.config import (
    Config,
    actor_parameters,
    config_of,
    recording_parameters,
    stage_parameters,
)
from ldo_service.config.printing import Setting, section_titles, settings_of
from ldo_service.errors import ConfigError
from ldo_service.viewer.view_config import viewer_config

SETTINGS = settings_of(Config())
NUMERIC = [s for s in SETTINGS if type(s.value) in (int, float)]
NUMBERS = [-1, 0, 0.5, 1, 2, 7, 1000, 10**5, 1e-9, 1e9, inf]
RETIRED = ("Whether ", "What ", "How ", "Who ", "Of ", "Where ")


def tree_of(path: str, value: Any) -> dict[str, Any]:
    for name in reversed(path.split(".")):
        value = {name: value}
    return value


def ids(setting: Setting) -> str:
    return setting.path


def test_the_number_and_the_depth_of_settings_stay_small() -> None:
    paper = [s for s in SETTINGS if s.path.startswith("paper.")]
    public = [s for s in SETTINGS if s.is_public]
    deepest = max(s.path.count(".") + 1 for s in SETTINGS)
    print(
        f"\n{len(SETTINGS) - len(paper)} settings, {len(public)} of them public, and "
        f"{len(paper)} of the paper; deepest path: {deepest} levels"
    )
    assert len(SETTINGS) - len(paper) <= 150
    assert len(public) == 66
    assert not any(s.is_public for s in paper)
    assert deepest <= 4


def test_every_setting_is_a_plain_value() -> None:
    for setting in SETTINGS:
        assert isinstance(setting.value, bool | int | float | str | tuple), setting.path


def test_every_setting_has_a_comment_of_short_sentences() -> None:
    for setting in SETTINGS:
        assert re.match(r"[A-Z0-9].*\.$", setting.comment), setting.path
        assert not setting.comment.startswith(RETIRED), setting.path
        longest = max(len(one.split()) for one in re.split(r"(?<=\.) ", setting.comment))
        assert longest <= 25, setting.path
    assert all(title.endswith(".") for title in section_titles().values())


@pytest.mark.parametrize("setting", NUMERIC, ids=ids)
def test_a_bad_number_is_named_with_its_path_and_value(setting: Setting) -> None:
    for bad, shown in ((-1, "-1"), (nan, "nan"), ("many", "many"), ([1, 2], "[1, 2]")):
        with pytest.raises(ConfigError) as raised:
            config_of(tree_of(setting.path, bad))
        assert str(raised.value).startswith(f"{setting.path}={shown} must be "), str(raised.value)


@pytest.mark.parametrize("setting", [s for s in SETTINGS if s not in NUMERIC], ids=ids)
def test_a_bad_value_of_another_type_is_named_with_its_path_and_value(setting: Setting) -> None:
    with pytest.raises(ConfigError) as raised:
        config_of(tree_of(setting.path, -1))
    assert str(raised.value).startswith(f"{setting.path}=-1 must be "), str(raised.value)


@pytest.mark.parametrize("setting", NUMERIC, ids=ids)
def test_number_accepted_by_the_configuration_is_accepted_by_the_actors(setting: Setting) -> None:
    for number in NUMBERS:
        shown = f"{number:g}" if isinstance(number, float) else str(number)
        if (raised := refusal(setting.path, number)) is None:
            parameters_of(config_of(tree_of(setting.path, number)))
        else:
            assert f"{setting.path}={shown}" in raised


def refusal(path: str, value: object) -> str | None:
    """Return the error message for a value, or None if it is accepted."""
    try:
        config_of(tree_of(path, value))
    except ConfigError as error:
        return str(error)
    return None


def parameters_of(config: Config) -> object:
    """Return the parameters of actors, stages, recordings, viewer and service."""
    return (
        actor_parameters(config),
        stage_parameters(config),
        recording_parameters(config),
        viewer_config(config.viewer),
        config.dataset,
        config.offline,
        config.service,
    )


def other_values(setting: Setting) -> list[Any]:
    """Return values of the same type, at least one of them valid and not the default."""
    match setting.value:
        case bool():
            return [not setting.value]
        case int():
            return [setting.value * 2 or 2, setting.value // 2]
        case float():
            return [setting.value * 0.9 or 0.5, setting.value * 1.1]
        case str():
            rules = ["yolov8", "semantic", "fixed", "iou", "box", "paper", "one_sided", "auto"]
            return ["elsewhere", *rules]
        case _:
            names = [["x {}"], ["optimizer"], ["color=/a"]]
            return [*names, [0.5, 0.5, 0.5], [2, 2], [0.6, 0.8, 0, 0], [1.0] * 16]


@pytest.mark.parametrize("setting", SETTINGS, ids=ids)
def test_every_setting_changes_the_parameters(setting: Setting) -> None:
    default = parameters_of(Config())
    for value in other_values(setting):
        if refusal(setting.path, value) is None:
            assert parameters_of(config_of(tree_of(setting.path, value))) != default
            return
    pytest.fail("no other value was accepted")


def test_no_error_prints_a_whole_parameter_object() -> None:
    package = Path(ldo_service.__file__).parent
    folders = [package, *(package / link for link in ("actors", "schemas"))]
    printing = [
        path
        for folder in folders
        for path in folder.resolve().rglob("*.py")
        if "{self}" in path.read_text()
    ]
    assert printing == []
