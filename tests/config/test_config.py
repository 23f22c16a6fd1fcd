"""Configuration: defaults, files, settings, and errors that say what to do."""

import dataclasses
from collections.abc import Iterator
from pathlib import Path

import pytest
import yaml

from ldo_service.config import Config, config_of, config_yaml, explained_yaml, load_config
from ldo_service.errors import ConfigError


def test_the_printed_configuration_reads_back_as_the_same() -> None:
    config = load_config(settings=["tracker.hold_out=5", "service.spawned=[mapper, optimizer]"])
    assert config_of(yaml.safe_load(config_yaml(config))) == config
    assert config_of(yaml.safe_load(explained_yaml(config))) == config


def test_a_reason_stands_with_its_own_setting() -> None:
    """Beside it, going on below it, or above it."""
    lines = explained_yaml(Config()).splitlines()
    reasons = {key.strip(): reason for key, _, reason in (line.partition("  # ") for line in lines)}
    assert reasons["begin_after_s: 3.0"].endswith("ORB-SLAM3's patience; 0: never")
    assert reasons["look_every: 17"].startswith("Frames between looks")
    assert reasons["look_every: 17"].endswith("mapping each time.")
    assert reasons["confirm_after: 7"] == "frames between looks while a find is to be confirmed"


def test_settings_change_what_the_file_left(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("tracker:\n  hold_out: 5\nmapper:\n  threads: 3\n")
    config = load_config(path, ["mapper.threads=2"])
    assert (config.tracker.hold_out, config.mapper.threads) == (5, 2)


@pytest.mark.parametrize("written", ["2e-1", "2E-1", ".2e0", "+2.e-1", "0.2", "200e-3"])
def test_exponents_are_those_of_yaml_1_2(written: str) -> None:
    assert load_config(settings=[f"stage.heartbeat_s={written}"]).stage.heartbeat_s == 0.2


def test_a_name_like_a_number_reads_back_as_the_name(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text('tracker:\n  localise: "1e5"\n')
    config = load_config(tmp_path / "mine.yaml")
    (tmp_path / "again.yaml").write_text(config_yaml(config))
    assert load_config(tmp_path / "again.yaml") == config
    assert config.tracker.localise == "1e5"


def test_an_empty_file_changes_nothing(tmp_path: Path) -> None:
    (tmp_path / "empty.yaml").write_text("")
    assert load_config(tmp_path / "empty.yaml") == Config()


@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("tracker.holdout=5", "Did you mean tracker.hold_out?"),
        ("traker.hold_out=5", "Did you mean tracker?"),
        ("tracker.hold_out=1", "must be 0, or 2 and more"),
        ("tracker.hold_out=many", "tracker.hold_out"),
        ("tracker.odometry.pyramid.levels=[", "not valid YAML"),
        ("hold_out=5", "section.field=value"),
        ("tracker.hold_out", "section.field=value"),
        ("tracker.hold_out.deeper=5", "Expected `int`"),
        ("mapper=3", "section.field=value"),
        ("stage.heartbeat_s=.nan", "stage.heartbeat_s is NaN"),
        ("stage.restart_delay_max_s=-1", "positive"),
    ],
)
def test_a_wrong_setting_is_said_plainly(setting: str, says: str) -> None:
    with pytest.raises(ConfigError, match=says.replace("?", r"\?")):
        load_config(settings=[setting])


def test_a_wrong_file_is_said_plainly(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="cannot be read"):
        load_config(tmp_path / "absent.yaml")
    for text, says in (("tracker: [", "not valid YAML"), ("- a\n- b\n", "must hold sections")):
        (tmp_path / "wrong.yaml").write_text(text)
        with pytest.raises(ConfigError, match=says):
            load_config(tmp_path / "wrong.yaml")


def every_field(config: object) -> Iterator[tuple[str, object]]:
    for entry in dataclasses.fields(config):  # type: ignore[arg-type]
        value = getattr(config, entry.name)
        if dataclasses.is_dataclass(value):
            yield from every_field(value)
        else:
            yield entry.name, value


def test_every_setting_is_a_plain_value() -> None:
    for name, value in every_field(Config()):
        assert isinstance(value, bool | int | float | str | tuple), name


@pytest.mark.parametrize(
    ("settings", "names"),
    [
        (["patience_s=55"], "stage.stall_after_s=60"),
        (["patience_s=30", "timeout_s=30"], "stage.stall_after_s=60"),
        (["patience_s=48"], "service.control_timeout_s=55"),
    ],
)
def test_no_labeller_behind_a_server_may_be_waited_for_until_it_is_given_up(
    settings: list[str], names: str
) -> None:
    """The service would end with it; a run has no such limits."""
    endpoint = [f"vlm_labeller.http.endpoint.{setting}" for setting in settings]
    load_config(settings=endpoint).check_patience()
    server = "vlm_labeller.url=http://127.0.0.1:8000/v1"
    config = load_config(settings=[server, *endpoint])
    with pytest.raises(ConfigError, match=f"together must be below {names}"):
        config.check_patience()
    load_config(settings=[server]).check_patience()
