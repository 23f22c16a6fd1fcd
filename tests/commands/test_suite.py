"""`ldo suite`: real runs of six frames."""

import json
from pathlib import Path

import pytest

from tests.commands.test_cli import ldo

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


def test_a_suite_runs_what_it_can_and_goes_on_where_it_stopped(capsys, suite: Path) -> None:
    words = "suite", suite, "--data", suite.parent, "--out", suite.parent / "out"
    code, out, err = ldo(capsys, *words)
    assert code == 1, "one failed"
    assert "1 of 3: room/plain@0" in err
    row = next(line for line in out.splitlines() if line.startswith("| plain"))
    _, _, ate_cm, away, broken, average, _ = (cell.strip() for cell in row.split("|"))
    assert 0 < float(ate_cm) < 1
    assert (away, broken, average) == ("no data", "failed", "-")
    assert (suite.parent / "out" / "table.md").read_text() == out
    made = suite.parent / "out" / "room" / "plain@0" / "summary.json"
    before = made.stat().st_mtime_ns
    assert ldo(capsys, *words)[1] == out
    assert made.stat().st_mtime_ns == before, "it is not run again"
    assert ldo(capsys, *words, "--set", "mapper.iterations=1")[1] != "", (
        "other settings, other runs"
    )
    assert made.stat().st_mtime_ns > before
    (made.parent / "eval.json").write_text("{")
    assert (
        "| failed | no data | failed |" in ldo(*(capsys, *words, "--set", "mapper.iterations=1"))[1]
    )


def test_variants_may_take_the_front_end_of_the_first(capsys, tmp_path: Path) -> None:
    variants = {"whole": ["mapper.iterations=1"], "rougher": ["mapper.iterations=0"]}
    path = tmp_path / "rooms.yaml"
    one = {"sequences": {"room": "synthetic:room"}, "variants": variants, "front_end": "whole"}
    path.write_text(json.dumps(SUITE | one | {"figures": ["ate_cm"]}))
    words = "suite", path, "--out", tmp_path / "out"
    assert ldo(capsys, *words)[0] == 0
    whole, rougher = (tmp_path / "out/room" / f"{name}@0" for name in variants)
    online = "trajectory_online.txt"
    assert (whole / online).read_bytes() == (rougher / online).read_bytes()
    assert (whole / "map.ply").read_bytes() != (rougher / "map.ply").read_bytes()
    stages = json.loads((rougher / "summary.json").read_text())["stage_ms"]
    assert "tracker" not in stages
    assert "mapper" in stages


def test_a_suite_that_is_not_there_is_named(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "suite", tmp_path / "none.yaml", "--out", tmp_path / "out")
    assert code == 2
    assert "there is no suite" in err
