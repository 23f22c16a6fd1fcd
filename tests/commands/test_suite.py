"""The command `ldo suite` with runs of six frames."""

import json
from pathlib import Path

import pytest

from tests.commands.test_cli import ldo
from tests.evaluation.onnx_file import write_network
from tests.evaluation.test_lpips import IMAGES, distance_nodes

SUITE = {
    "title": "Rooms",
    "sequences": {"room": "synthetic:room", "away": "somewhere/else", "broken": "broken"},
    "variants": {"plain": []},
    "figures": ["ate_cm", "fps"],
    "max_frames": 6,
}


@pytest.fixture
def suite(tmp_path: Path) -> Path:
    (tmp_path / "broken").mkdir()
    path = tmp_path / "rooms.yaml"
    path.write_text(json.dumps(SUITE))
    return path


def test_suite_runs_available_sequences_and_continues_where_it_stopped(capsys, suite: Path) -> None:
    arguments = "suite", suite, "--data", suite.parent, "--out", suite.parent / "out"
    code, out, err = ldo(capsys, *arguments)
    assert code == 1, "one failed"
    assert "1 of 3: room/plain@0" in err
    row = next(line for line in out.splitlines() if line.startswith("| plain"))
    _, _, ate_cm, away, broken, average, _ = (cell.strip() for cell in row.split("|"))
    assert 0 < float(ate_cm) < 1
    assert (away, broken, average) == ("no data", "failed", "-")
    assert (suite.parent / "out" / "table.md").read_text() == out
    summary = suite.parent / "out" / "room" / "plain@0" / "summary.json"
    before = summary.stat().st_mtime_ns
    assert ldo(capsys, *arguments)[1] == out
    assert summary.stat().st_mtime_ns == before, "it is not run again"
    assert ldo(capsys, *arguments, "--set", "mapper.iterations=1")[1] != "", (
        "other settings, other runs"
    )
    assert summary.stat().st_mtime_ns > before
    (summary.parent / "eval.json").write_text("{")
    repeated = ldo(capsys, *arguments, "--set", "mapper.iterations=1")[1]
    assert "| failed |" not in repeated.split("broken")[0], "a damaged result is run again"
    assert json.loads((summary.parent / "eval.json").read_text())["trajectory"]


def test_later_variants_can_reuse_the_front_end_of_the_first(capsys, tmp_path: Path) -> None:
    variants = {"whole": ["mapper.iterations=1"], "rougher": ["mapper.iterations=0"]}
    path = tmp_path / "rooms.yaml"
    one = {"sequences": {"room": "synthetic:room"}, "variants": variants, "front_end": "whole"}
    path.write_text(json.dumps(SUITE | one | {"figures": ["ate_cm"]}))
    arguments = "suite", path, "--out", tmp_path / "out"
    assert ldo(capsys, *arguments)[0] == 0
    first_run, second_run = (tmp_path / "out/room" / f"{name}@0" for name in variants)
    online = "trajectory_online.txt"
    assert (first_run / online).read_bytes() == (second_run / online).read_bytes()
    assert (first_run / "map.ply").read_bytes() != (second_run / "map.ply").read_bytes()
    stages = json.loads((second_run / "summary.json").read_text())["stage_ms"]
    assert "tracker" not in stages
    assert "mapper" in stages


def test_lpips_of_a_network_has_a_column(capsys, tmp_path: Path) -> None:
    network = write_network(tmp_path / "net.onnx", distance_nodes(), IMAGES)
    path = tmp_path / "rooms.yaml"
    one = {"sequences": {"room": "synthetic:room"}, "figures": ["lpips_training"]}
    path.write_text(json.dumps(SUITE | one))
    arguments = "suite", path, "--out", tmp_path / "out", "--lpips", network
    code, out, _ = ldo(capsys, *arguments)
    assert code == 0
    assert "| room | LPIPS, training views |" in out
    run = tmp_path / "out" / "room" / "plain@0"
    found = json.loads((run / "eval.json").read_text())
    assert found["lpips"] == str(network)
    (training,) = (row for row in found["rendering"] if row["protocol"] == "B training")
    assert training["mean"]["lpips"] > 0
    assert f"| plain | {training['mean']['lpips']:.3f} |" in out
    assert ldo(capsys, *arguments)[1] == out, "a finished run is kept"


def test_wrong_network_of_lpips_is_refused_before_any_run(capsys, suite: Path) -> None:
    out = suite.parent / "out"
    code, _, err = ldo(capsys, "suite", suite, "--out", out, "--lpips", suite)
    assert code == 2
    assert f"--lpips {suite} cannot be opened" in err
    assert not out.exists()


def test_network_that_fails_on_the_images_fails_the_run(capsys, caplog, tmp_path: Path) -> None:
    network = write_network(
        tmp_path / "net.onnx", distance_nodes(), dict.fromkeys(IMAGES, (1, 3, 64, 64))
    )
    path = tmp_path / "rooms.yaml"
    one = {"sequences": {"room": "synthetic:room"}, "figures": ["lpips_training"]}
    path.write_text(json.dumps(SUITE | one))
    code, out, _ = ldo(capsys, "suite", path, "--out", tmp_path / "out", "--lpips", network)
    assert code == 1
    assert "| plain | failed |" in out
    assert "dynamic height and width" in caplog.text


def test_missing_suite_is_named_in_the_error(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "suite", tmp_path / "none.yaml", "--out", tmp_path / "out")
    assert code == 2
    assert "there is no suite" in err
