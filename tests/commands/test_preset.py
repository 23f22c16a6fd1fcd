"""The option `--preset` of the commands."""

from pathlib import Path

import pytest
import yaml

from ldo_service.config import load_config
from tests.batch.slices import write_slice
from tests.commands.test_cli import ldo

LITERAL = "--preset", "paper"
SET = "--set", "paper.label_region=foreground", "--set", "mapper.iterations=1"
CHANGED = "preset=paper", *SET[1::2]


def test_config_prints_the_preset_as_changed_by_set(capsys) -> None:
    code, out, _ = ldo(capsys, "config", *LITERAL, *SET)
    assert code == 0
    printed = yaml.safe_load(out)
    assert printed["paper"]["assignment_rule"] == "iou"
    assert "label_region" not in printed["paper"], "--set restores the default"
    assert printed["mapper"]["iterations"] == 1
    assert printed["loop_closer"]["retrieval"]["mode"] == "semantic"
    code, out, _ = ldo(capsys, "config")
    assert "assignment_rule" not in out


def test_run_uses_the_preset_as_changed_by_set(capsys, room_folder: Path, tmp_path: Path) -> None:
    arguments = "--out", tmp_path / "out", "--max-frames", "3", "--threads", "1"
    code, _, err = ldo(capsys, "run", room_folder, *arguments, *LITERAL, *SET)
    assert code == 0, err
    used = load_config(tmp_path / "out/config.yaml")
    wanted = load_config(settings=CHANGED)
    assert used.paper == wanted.paper
    assert used.loop_closer.retrieval == wanted.loop_closer.retrieval
    assert used.mapper.iterations == 1


def test_batch_uses_the_preset_as_changed_by_set(capsys, room_folder: Path, tmp_path: Path) -> None:
    write_slice(room_folder, tmp_path / "night/desk", 0, 3)
    arguments = tmp_path / "night", "--out", tmp_path / "out"
    code, _, err = ldo(capsys, "batch", *arguments, *LITERAL, *SET)
    assert code == 0, err
    (result,) = (tmp_path / "out").glob("desk-*")
    assert load_config(result / "config.yaml").paper == load_config(settings=CHANGED).paper


@pytest.mark.parametrize(
    "arguments",
    ["config", "run synthetic:room --out o", "simulate synthetic:room", "batch a --out o", "serve"],
)
def test_unknown_preset_is_a_configuration_error(capsys, arguments: str) -> None:
    code, _, err = ldo(capsys, *arguments.split(), "--preset", "papr")
    assert code == 2
    assert "preset=papr must be the name of a preset. Did you mean paper?" in err
