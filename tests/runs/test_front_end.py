"""Kept front ends, reused with equal results or refused."""

import csv
import json
from dataclasses import replace
from pathlib import Path

import pytest

from ldo_service.config import load_config
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError, DataError, FrameError, StageError
from ldo_service.geometry import RawFrame
from ldo_service.runs.front_end import FRONT_END, FrontEnd, front_end_settings
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection

from .jobs import OUT_AND_BACK, ROUGH, SHORT_GAP, Rearranged, job

SETTINGS = (SHORT_GAP, "detector.model=demo")
BAD = 7  # Index of the unreadable frame.
FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.json", "map.ply", "objects.json")


class WithBadFrame(Rearranged):
    def read(self, index: int) -> RawFrame:
        if index == BAD:
            raise FrameError(f"frame {index} is truncated. Copy it again.")
        return super().read(index)


class NeverRead(Rearranged):
    def read(self, index: int) -> RawFrame:
        raise AssertionError(f"frame {index} is read again; the front end has read it already")


@pytest.fixture(scope="module")
def walk(room: Sequence) -> Sequence:
    return WithBadFrame(room, OUT_AND_BACK)


@pytest.fixture(scope="module")
def full_run(walk: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("front_end") / "full"
    run_offline(replace(job(walk, folder, *SETTINGS), keep_front_end=True), lambda *_: None)
    return folder


@pytest.fixture(scope="module")
def reused_run(room: Sequence, full_run: Path) -> Path:
    return run_with_front_end(room, full_run, full_run.parent / "reused")


def run_with_front_end(room: Sequence, full_run: Path, folder: Path, *settings: str) -> Path:
    """Run all actors behind a kept front end, and return the folder of the run."""
    options = job(NeverRead(room, OUT_AND_BACK), folder, *SETTINGS, *settings)
    front_end = FrontEnd.open(full_run, options.config, options.sequence, options.selection)
    run_offline(replace(options, front_end=front_end), lambda *_: None)
    return folder


def opened(
    full_run: Path, sequence: Sequence, *settings: str, frames: int | None = None
) -> FrontEnd:
    config = load_config(settings=(ROUGH, *SETTINGS, *settings))
    return FrontEnd.open(full_run, config, sequence, Selection(max_frames=frames))


def loops_of(folder: Path) -> list[tuple[list[int], list[int]]]:
    found = json.loads((folder / "loops.json").read_text())
    return [(one["keyframes"], one["reference_keyframes"]) for one in found["candidates"]]


def test_reused_front_end_gives_the_files_of_the_full_run(full_run: Path, reused_run: Path) -> None:
    for name in FILES:
        assert (reused_run / name).read_bytes() == (full_run / name).read_bytes(), name
    assert loops_of(reused_run) == loops_of(full_run) != []
    reused, full = (json.loads((f / "summary.json").read_text()) for f in (reused_run, full_run))
    for name in ("frames", "frames_rejected", "status", "keyframes", "boxes", "loops_accepted"):
        assert reused[name] == full[name], name
    assert reused["frames_rejected"] == 1
    assert full["boxes"] > 0
    assert (bool(full["calibration"]), reused["calibration"]) == (True, {})
    assert reused["stage_ms"].keys() == full["stage_ms"].keys() - {
        *("frame_source", "tracker", "detector")
    }


def test_reused_front_end_gives_equal_rows_of_frames(full_run: Path, reused_run: Path) -> None:
    reused, full = (
        list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))
        for folder in (reused_run, full_run)
    )
    assert [row | {"track_ms": ""} for row in reused] == [row | {"track_ms": ""} for row in full]
    assert {row["track_ms"] for row in reused} == {"0.000"}  # The reused run has no tracker.


def test_other_mapper_setting_changes_the_map_and_no_online_pose(
    room: Sequence, full_run: Path, tmp_path: Path
) -> None:
    other = run_with_front_end(room, full_run, tmp_path / "other", "mapper.iterations=0")
    online = "trajectory_online.txt"
    assert (other / online).read_bytes() == (full_run / online).read_bytes()
    assert (other / "map.ply").read_bytes() != (full_run / "map.ply").read_bytes()


def test_changed_front_end_setting_is_refused(walk: Sequence, full_run: Path) -> None:
    with pytest.raises(ConfigError, match=r"tracker\.hold_out=5 must be 0, "):
        opened(full_run, walk, "tracker.hold_out=5")
    with pytest.raises(ConfigError, match=r"offline\.latency_frames\.detector=4 must be 3"):
        opened(full_run, walk, "offline.latency_frames.detector=4")


def test_other_frames_are_refused(room: Sequence, walk: Sequence, full_run: Path) -> None:
    with pytest.raises(DataError, match=f"has {len(OUT_AND_BACK)} frames of .*this run has 12 of"):
        opened(full_run, walk, frames=12)
    later = Rearranged(room, OUT_AND_BACK)
    later.stamps_ns = later.stamps_ns + 1
    with pytest.raises(DataError, match=r"stamps, .* must be the same"):
        opened(full_run, later)


def test_run_without_a_front_end_is_refused(walk: Sequence, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no front_end\.mcap\..* --keep-front-end"):
        opened(tmp_path, walk)


def test_invalid_front_end_file_is_refused(walk: Sequence, tmp_path: Path) -> None:
    (tmp_path / FRONT_END).write_bytes(b"not MCAP")
    with pytest.raises(DataError, match="cannot be read as a recording"):
        opened(tmp_path, walk)


def test_truncated_front_end_file_is_refused(
    walk: Sequence, full_run: Path, tmp_path: Path
) -> None:
    body = (full_run / FRONT_END).read_bytes()
    (tmp_path / FRONT_END).write_bytes(body[: len(body) // 2])
    with pytest.raises(DataError, match="is not complete"):
        opened(tmp_path, walk)


def test_failed_run_leaves_no_front_end(
    room: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("ldo_service.actors.loop_closer.LoopCloser.handle", fails)
    options = job(Rearranged(room, OUT_AND_BACK), tmp_path / "out")
    with pytest.raises(StageError, match="out of luck"):
        run_offline(replace(options, keep_front_end=True), lambda *_: None)
    monkeypatch.undo()
    assert not (tmp_path / "out" / FRONT_END).exists()


def test_front_end_beyond_the_size_limit_is_removed(room: Sequence, tmp_path: Path) -> None:
    tight = "recording.max_gb=0.0000001"
    options = job(Rearranged(room, OUT_AND_BACK), tmp_path / "out", tight, frames=8)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ldo_service.recordings.mcap_file.CHECK_EVERY_BYTES", 1000)
        record = run_offline(replace(options, keep_front_end=True), lambda *_: None)
    assert record.summary["frames"] == 8  # The run continues.
    assert not (tmp_path / "out" / FRONT_END).exists()


def test_front_end_is_complete_once_the_stream_has_ended(
    room: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ldo_service.runs.offline.OfflineRun.repair", fails)
    options = job(Rearranged(room, OUT_AND_BACK), tmp_path / "out", frames=8)
    with pytest.raises(KeyboardInterrupt):
        run_offline(replace(options, keep_front_end=True), lambda *_: None)
    kept = FrontEnd.open(tmp_path / "out", options.config, options.sequence, options.selection)
    assert kept.rejected == 0


def test_front_end_of_a_version_with_other_settings_is_refused(
    walk: Sequence, full_run: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    options = load_config(settings=(ROUGH, *SETTINGS))
    more = front_end_settings(options) | {"tracker.clairvoyance": True}
    monkeypatch.setattr("ldo_service.runs.front_end.front_end_settings", lambda _: more)
    with pytest.raises(DataError, match=r"was recorded by LDO-SLAM .*whose settings differ"):
        FrontEnd.open(full_run, options, walk, Selection())
