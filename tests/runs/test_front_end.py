"""A front end that was kept: heard again, the others make the same; with other settings, others."""

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

from .jobs import AND_BACK, LONG_AGO, ROUGH, Rearranged, job

SETTINGS = (LONG_AGO, "detector.model=demo")
BAD = 7  # frame that cannot be read
MADE = ("trajectory.txt", "trajectory_online.txt", "keyframes.json", "map.ply", "objects.json")


class Spoilt(Rearranged):
    def read(self, index: int) -> RawFrame:
        if index == BAD:
            raise FrameError(f"frame {index} is truncated. Copy it again.")
        return super().read(index)


class Unread(Rearranged):
    def read(self, index: int) -> RawFrame:
        raise AssertionError(f"frame {index} is read, which a front end has seen")


@pytest.fixture(scope="module")
def walk(room: Sequence) -> Sequence:
    return Spoilt(room, AND_BACK)


@pytest.fixture(scope="module")
def whole(walk: Sequence, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("front_end") / "whole"
    run_offline(replace(job(walk, folder, *SETTINGS), keep_front_end=True), lambda *_: None)
    return folder


@pytest.fixture(scope="module")
def alike(room: Sequence, whole: Path) -> Path:
    return again(room, whole, whole.parent / "alike")


def again(room: Sequence, whole: Path, folder: Path, *settings: str) -> Path:
    """A run of the others, by what was kept."""
    asked = job(Unread(room, AND_BACK), folder, *SETTINGS, *settings)
    front_end = FrontEnd.open(whole, asked.config, asked.sequence, asked.selection)
    run_offline(replace(asked, front_end=front_end), lambda *_: None)
    return folder


def opened(whole: Path, sequence: Sequence, *settings: str, frames: int | None = None) -> FrontEnd:
    config = load_config(settings=(ROUGH, *SETTINGS, *settings))
    return FrontEnd.open(whole, config, sequence, Selection(max_frames=frames))


def loops_of(folder: Path) -> list[tuple[list[int], list[int]]]:
    found = json.loads((folder / "loops.json").read_text())
    return [(one["keyframes"], one["reference_keyframes"]) for one in found["candidates"]]


def test_what_is_made_of_it_is_what_the_whole_run_made(whole: Path, alike: Path) -> None:
    for name in MADE:
        assert (alike / name).read_bytes() == (whole / name).read_bytes(), name
    assert loops_of(alike) == loops_of(whole) != []
    ours, theirs = (json.loads((f / "summary.json").read_text()) for f in (alike, whole))
    for name in ("frames", "frames_rejected", "status", "keyframes", "boxes", "loops_accepted"):
        assert ours[name] == theirs[name], name
    assert ours["frames_rejected"] == 1
    assert theirs["boxes"] > 0
    assert ours["stage_ms"].keys() == theirs["stage_ms"].keys() - {
        *("frame_source", "tracker", "detector")
    }


def test_frames_are_told_as_they_were(whole: Path, alike: Path) -> None:
    ours, theirs = (
        list(csv.DictReader((folder / "frames.csv").read_text().splitlines()))
        for folder in (alike, whole)
    )
    assert [row | {"track_ms": ""} for row in ours] == [row | {"track_ms": ""} for row in theirs]
    assert {row["track_ms"] for row in ours} == {"0.000"}  # nobody tracked


def test_another_map_is_made_of_the_same_poses(room: Sequence, whole: Path, tmp_path: Path) -> None:
    other = again(room, whole, tmp_path / "other", "mapper.iterations=0")
    online = "trajectory_online.txt"
    assert (other / online).read_bytes() == (whole / online).read_bytes()
    assert (other / "map.ply").read_bytes() != (whole / "map.ply").read_bytes()


def test_a_setting_that_would_have_no_effect_is_refused(walk: Sequence, whole: Path) -> None:
    with pytest.raises(ConfigError, match=r"tracker\.hold_out=5 was 0 when"):
        opened(whole, walk, "tracker.hold_out=5")
    with pytest.raises(ConfigError, match=r"offline\.latency_frames\.detector=4 was 3"):
        opened(whole, walk, "offline.latency_frames.detector=4")


def test_other_frames_are_refused(room: Sequence, walk: Sequence, whole: Path) -> None:
    with pytest.raises(DataError, match=f"has {len(AND_BACK)} frames of .*this run has 12 of"):
        opened(whole, walk, frames=12)
    later = Rearranged(room, AND_BACK)
    later.stamps_ns = later.stamps_ns + 1
    with pytest.raises(DataError, match=r"stamps, .* must be the same"):
        opened(whole, later)


def test_a_run_that_kept_none_is_refused(walk: Sequence, tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"has no front_end\.mcap: `ldo run --keep-front-end`"):
        opened(tmp_path, walk)


def test_what_is_no_recording_is_refused(walk: Sequence, tmp_path: Path) -> None:
    (tmp_path / FRONT_END).write_bytes(b"not MCAP")
    with pytest.raises(DataError, match="cannot be read as a recording"):
        opened(tmp_path, walk)


def test_a_file_that_was_cut_off_is_refused(walk: Sequence, whole: Path, tmp_path: Path) -> None:
    body = (whole / FRONT_END).read_bytes()
    (tmp_path / FRONT_END).write_bytes(body[: len(body) // 2])
    with pytest.raises(DataError, match="is not complete"):
        opened(tmp_path, walk)


def test_a_run_that_fails_leaves_none_for_others(
    room: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(*_: object) -> None:
        raise RuntimeError("out of luck")

    monkeypatch.setattr("ldo_service.actors.loop_closer.LoopCloser.handle", fails)
    asked = job(Rearranged(room, AND_BACK), tmp_path / "out")
    with pytest.raises(StageError, match="out of luck"):
        run_offline(replace(asked, keep_front_end=True), lambda *_: None)
    monkeypatch.undo()
    assert not (tmp_path / "out" / FRONT_END).exists()


def test_one_that_grows_too_large_is_not_whole(room: Sequence, tmp_path: Path) -> None:
    tight = "recording.max_gb=0.0000001"
    asked = job(Rearranged(room, AND_BACK), tmp_path / "out", tight)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("ldo_service.recordings.mcap_file.CHECK_EVERY_BYTES", 1000)
        record = run_offline(replace(asked, keep_front_end=True), lambda *_: None)
    assert record.summary["frames"] == len(AND_BACK)  # the run goes on
    assert not (tmp_path / "out" / FRONT_END).exists()


def test_it_is_whole_when_the_stream_ends(
    room: Sequence, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("ldo_service.runs.offline.OfflineRun.repair", fails)
    asked = job(Rearranged(room, AND_BACK), tmp_path / "out")
    with pytest.raises(KeyboardInterrupt):
        run_offline(replace(asked, keep_front_end=True), lambda *_: None)
    kept = FrontEnd.open(tmp_path / "out", asked.config, asked.sequence, asked.selection)
    assert kept.rejected == 0


def test_one_of_a_version_with_other_settings_is_refused(
    walk: Sequence, whole: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked = load_config(settings=(ROUGH, *SETTINGS))
    more = front_end_settings(asked) | {"tracker.clairvoyance": True}
    monkeypatch.setattr("ldo_service.runs.front_end.front_end_settings", lambda _: more)
    with pytest.raises(DataError, match=r"is of LDO-SLAM .*had other settings than this"):
        FrontEnd.open(whole, asked, walk, Selection())
