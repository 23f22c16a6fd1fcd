"""Batches on this machine: digests, repeated calls, failures and damaged results."""

import json
import os
import shutil
import signal
from collections.abc import Callable
from pathlib import Path

import fsspec
import pytest

from ldo_service.batch import LocalExecutor, Outcome, executors, process
from ldo_service.batch.batch import Batch
from ldo_service.batch.results import ResultFolder
from ldo_service.batch.sources import measure
from ldo_service.batch.work import sample
from ldo_service.config import config_yaml, load_config
from ldo_service.datasets import open_sequence
from ldo_service.evaluation.finished_run import RunFrame
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection
from tests.batch.slices import write_slice

MakeBatch = Callable[..., Batch]
FRAMES = 4


@pytest.fixture
def part(room_folder: Path, tmp_path: Path) -> Path:
    """Return a recording of a few frames."""
    return write_slice(room_folder, tmp_path / "part", 0, FRAMES)


class Here:
    """Executor that processes jobs in this process, which saves the start of a process."""

    def outcomes(self, jobs):
        yield from map(process, jobs)


def run(batch: Batch, *sources: Path | str, executor=None) -> list[Outcome]:
    words = [str(source) for source in sources]
    return list(batch.outcomes(words, executor or Here(), lambda _: None))


def test_results_in_a_process_are_those_of_a_run_and_are_kept(
    batch: MakeBatch, part: Path, tmp_path: Path
) -> None:
    (outcome,) = run(batch(exports=("splat",)), part, executor=LocalExecutor(2))
    assert (outcome.status, outcome.error, outcome.notes) == ("done", "", ())
    folder = tmp_path / "out" / outcome.folder
    prepare(tmp_path / "run", overwrite=False)
    config, sequence = load_config(settings=("mapper.iterations=1",)), open_sequence(str(part))
    job = RunOptions(sequence, tmp_path / "run", config, Selection(), pytest.fail)
    run_offline(job, lambda *_: None)
    for name in ("map.ply", "trajectory.txt", "trajectory_online.txt", "keyframe_database.msgpack"):
        assert (folder / name).read_bytes() == (tmp_path / "run" / name).read_bytes(), name
    assert (folder / "gaussians.splat").is_file()
    assert all((folder / picture).is_file() for picture in outcome.pictures)
    assert len(outcome.pictures) == 2
    assert outcome.summary["ate_m"] < 0.01
    assert outcome.costs is not None
    assert outcome.costs.cpu_s > outcome.costs.run_cpu_s > 0
    assert outcome.costs.result_bytes > outcome.costs.source_bytes / 10 > 0
    (kept,) = run(batch(exports=("splat",)), part, executor=LocalExecutor(2))
    assert kept.status == "kept"
    assert (kept.digest, kept.costs) == (outcome.digest, outcome.costs)


def test_digest_is_the_same_from_a_bucket_and_with_other_threads(
    batch: MakeBatch, part: Path
) -> None:
    bucket = fsspec.filesystem("memory")
    bucket.put(f"{part}/", "/robots/part", recursive=True)
    (here,) = run(batch(), part)
    (remote,) = run(batch("memory://results/night", threads=2), "memory:///robots/part")
    assert (remote.status, remote.digest) == ("done", here.digest)
    stored = f"/results/night/{remote.folder}"
    assert bucket.size(f"{stored}/map.ply") > 0
    (kept,) = run(batch("memory://results/night"), "memory:///robots/part")
    assert kept.status == "kept"
    bucket.pipe_file(f"{stored}/map.ply", bucket.cat_file(f"{stored}/map.ply")[:-1])
    (again,) = run(batch("memory://results/night"), "memory:///robots/part")
    assert (again.status, again.digest) == ("done", here.digest)
    for folder in ("/robots", "/results"):
        bucket.rm(folder, recursive=True)


def test_recording_without_truth_gets_pictures_of_a_few_frames(
    batch: MakeBatch, room_folder: Path, tmp_path: Path
) -> None:
    part = write_slice(room_folder, tmp_path / "part", 0, 16)
    (part / "groundtruth.txt").unlink()
    (few,) = run(batch(stride=1), part)
    (every,) = run(batch(evaluates_all=True), part)
    assert (few.summary["psnr_frames"], every.summary["psnr_frames"]) == (4, 4)
    assert few.pictures == every.pictures == ("trajectory.png", "rendering.png")
    assert "ate_m" not in few.summary
    assert not (tmp_path / "out" / few.folder / "eval.json").exists()
    assert (tmp_path / "out" / every.folder / "eval.json").exists()


@pytest.mark.parametrize(("hold_out", "expected"), [(4, [3, 11, 19]), (0, [0, 10, 20])])
def test_sample_is_spread_over_the_frames_with_a_pose(hold_out: int, expected: list[int]) -> None:
    frames = [
        RunFrame(k, k, "LOST" if k > 20 else "OK", bool(hold_out) and k % hold_out == hold_out - 1)
        for k in range(30)
    ]
    chosen = sample(frames, 3)
    assert [frame.index for frame in chosen.posed] == expected
    assert [frame.index for frame in chosen.held_out] == (expected if hold_out else [])
    assert sample(frames[21:], 3).posed == []


@pytest.mark.parametrize("damage", ["truncated", "missing", "unfinished", "garbled"])
def test_partial_result_is_made_again(
    batch: MakeBatch, part: Path, tmp_path: Path, damage: str
) -> None:
    (first,) = run(batch(), part)
    folder = tmp_path / "out" / first.folder
    match damage:
        case "truncated":
            os.truncate(folder / "map.ply", 100)
        case "missing":
            (folder / "trajectory.txt").unlink()
        case "unfinished":
            (folder / "result.json").unlink()
        case "garbled":
            os.truncate(folder / "result.json", 50)
    (second,) = run(batch(), part)
    assert (second.status, second.digest) == ("done", first.digest)
    (third,) = run(batch(), part)
    assert third.status == "kept"


def test_key_depends_on_content_and_configuration_and_not_on_path_and_threads(
    batch: MakeBatch, part: Path, tmp_path: Path
) -> None:
    def key(source: Path, **options) -> str:
        return batch(**options).job(measure(str(source))).key

    own = key(part)
    assert key(part.rename(tmp_path / "moved"), threads=2) == own
    changed = [
        key(tmp_path / "moved", **o) for o in ({"stride": 2}, {"refine": 1}, {"max_frames": 2})
    ]
    (tmp_path / "moved/groundtruth.txt").write_text("0 0 0 0 0 0 0 1\n")
    assert len({own, *changed, key(tmp_path / "moved")}) == 5


def test_failures_are_one_line_each_and_do_not_stop_the_others(
    batch: MakeBatch, part: Path, tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    broken.mkdir()
    (broken / "rgb.txt").write_text("nothing\n")
    absent, copy = tmp_path / "absent", tmp_path / "copies/part"
    copy.parent.mkdir()
    os.symlink(part, copy)
    outcomes = {o.source: o for o in run(batch(), broken, absent, "synthetic:rom", part, copy)}
    assert "has no known layout" in outcomes[str(broken)].error
    assert "does not exist or is empty" in outcomes[str(absent)].error
    assert "unknown sequence synthetic:rom" in outcomes["synthetic:rom"].error
    assert outcomes[str(part)].status == "done"
    assert outcomes[str(copy)].status == "duplicate"
    assert all("\n" not in outcome.error for outcome in outcomes.values())


def test_two_recordings_of_one_name_have_two_folders(
    batch: MakeBatch, room_folder: Path, tmp_path: Path
) -> None:
    sources = [write_slice(room_folder, tmp_path / f"{day}/desk", day, 2) for day in (1, 2)]
    outcomes = run(batch(), *sources)
    assert [outcome.name for outcome in outcomes] == ["desk", "desk"]
    assert len({outcome.folder for outcome in outcomes}) == 2


def test_file_that_no_batch_wrote_is_not_replaced(
    batch: MakeBatch, part: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "out" / batch().job(measure(str(part))).folder
    folder.mkdir(parents=True)
    (folder / "thesis.tex").write_text("years of work")
    (outcome,) = run(batch(), part)
    assert "thesis.tex, which no run wrote" in outcome.error
    assert (folder / "thesis.tex").read_text() == "years of work"


def test_full_disk_of_the_results_is_one_line(
    batch: MakeBatch, part: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(source: Path, target: Path) -> None:
        raise shutil.Error([(str(source), str(target), "[Errno 28] No space left on device")])

    monkeypatch.setattr(shutil, "move", full)
    (outcome,) = run(batch(), part)
    assert "cannot be written: [Errno 28] No space left on device. Free some" in outcome.error
    assert list((tmp_path / "out").iterdir()) == []


def test_other_version_on_a_worker_is_refused(batch: MakeBatch, part: Path) -> None:
    job = batch().job(measure(str(part)))
    other = process(
        type(job)(**{n: getattr(job, n) for n in job.__struct_fields__} | {"version": "9"})
    )
    assert "was started with 9. Install the same version" in other.error


def test_process_that_is_killed_fails_alone(
    batch: MakeBatch, part: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = batch()
    jobs = [made.job(measure(source)) for source in (str(part), "synthetic:room")]
    monkeypatch.setattr(executors, "process", _killed_in_a_room)
    killed, done = sorted(LocalExecutor(2).outcomes(jobs), key=lambda o: o.status, reverse=True)
    assert (killed.status, done.status) == ("failed", "done")
    assert killed.source == "synthetic:room"
    assert "its process was killed" in killed.error


def _killed_in_a_room(job) -> Outcome:
    if job.recording.source == "synthetic:room":
        os.kill(os.getpid(), signal.SIGKILL)
    return process(job)


def test_configuration_of_a_result_is_that_of_the_plan(
    batch: MakeBatch, part: Path, tmp_path: Path
) -> None:
    (outcome,) = run(batch(), part)
    text = (tmp_path / "out" / outcome.folder / "config.yaml").read_text()
    assert text == config_yaml(batch().plan.config)
    result = json.loads((tmp_path / "out" / outcome.folder / "result.json").read_text())
    assert result["files"]["config.yaml"]["size_bytes"] == len(text)
    assert ResultFolder.of(batch().job(measure(str(part)))).finished() is not None
