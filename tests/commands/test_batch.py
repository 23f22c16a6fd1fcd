"""The command `ldo batch`: table, report, exit codes, interruption, and missing extras."""

import json
import re
import signal
import sys
import time
from pathlib import Path

import pytest

from ldo_service.batch.report import page, report_of
from ldo_service.commands.batch import _Progress
from tests.batch.slices import write_slice
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.commands.test_interrupt import started

QUICK = "--set", "mapper.iterations=1", "--max-frames", "4"


@pytest.fixture
def night(room_folder: Path, tmp_path: Path) -> Path:
    """Return a folder with one recording."""
    write_slice(room_folder, tmp_path / "night/desk", 0, 4)
    return tmp_path / "night"


def test_batch_prints_a_table_and_writes_a_report_with_pictures(
    capsys, night: Path, tmp_path: Path
) -> None:
    (tmp_path / "list.txt").write_text("absent <b>\n")
    where = tmp_path / "out"
    arguments = "batch", night, "--sources-from", tmp_path / "list.txt", "--out", where, *QUICK
    code, out, err = ldo(capsys, *arguments)
    assert code == 1, "one failed"
    assert re.search(r"│ desk +│ done +│ +4 │", out)
    assert re.search(r"│ absent <b> +│ failed +│", out)
    assert f"{where}/index.html" in out
    assert "1 of 2: absent <b> failed: " in err
    assert re.search(r"2 of 2: desk done in \d+ s", err)
    report = json.loads((where / "batch.json").read_text())
    assert report["counts"] == {"done": 1, "failed": 1}
    assert not report["is_interrupted"]
    html = (where / "index.html").read_text()
    assert "absent &lt;b&gt; does not exist" in html
    pictures = re.findall(r'src="([^"]+)"', html)
    assert len(pictures) == 2
    assert all((where / picture).is_file() for picture in pictures)
    assert not re.search(r"https?://", html), "the page loads nothing from elsewhere"
    (tmp_path / "list.txt").write_text("")
    code, out, _ = ldo(capsys, *arguments)
    assert code == 0
    assert re.search(r"│ desk +│ kept +│", out)


def test_device_of_the_option_applies_to_all_recordings(
    capsys, night: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "")  # The CPU replaces the missing GPU.
    where = tmp_path / "out"
    code, _, _ = ldo(capsys, "batch", night, "--out", where, "--device", "cuda", *QUICK)
    assert code == 0
    (summary,) = (json.loads(path.read_text()) for path in where.glob("desk-*/summary.json"))
    assert {"mapper", "tracker"} <= set(summary["devices_failed"])
    (outcome,) = json.loads((where / "batch.json").read_text())["recordings"]
    assert any("no GPU can be used" in note for note in outcome["notes"])


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        ("--out o", 2, "no SOURCES are given"),
        ("absent --out o", 3, "absent does not exist"),
        ("absent/* --out o", 3, "no recording matches absent/*."),
        ("synthetic:room --out /proc/x", 3, "/proc/x/batch.json cannot be written"),
        ("synthetic:room --out s3x://x", 2, "the protocol s3x:// is unknown. Did you mean s3?"),
        ("synthetic:room --out o --workers 0", 2, "--workers 0 must be positive"),
        ("synthetic:room --out o --gpus 1", 2, "--gpus 1 applies only with --cluster"),
        ("synthetic:room --out o --stride 5 --hold-out-every 5", 2, "have a common factor"),
        ("synthetic:room --out o --set detector.model=absent", 2, "detector.model=absent"),
        ("--sources-from absent --out o", 2, "the list of sources absent cannot be read"),
    ],
)
def test_wrong_argument_is_one_paragraph(
    capsys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arguments: str, code: int, message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    found, _, err = ldo(capsys, "batch", *arguments.split())
    assert found == code
    assert_one_paragraph(err)
    assert message in err


@pytest.mark.parametrize(
    ("module", "option", "message"),
    [
        ("ray", ("--cluster", "auto"), "--cluster needs the extra `cluster` ("),
        ("s3fs", ("--out", "s3://x"), "s3:// needs the extra `s3`. Install it by `.venv/bin/pip"),
    ],
)
def test_missing_extra_is_named_in_one_line(
    capsys,
    monkeypatch: pytest.MonkeyPatch,
    tmp_path: Path,
    module: str,
    option: tuple[str, str],
    message: str,
) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    where = () if "--out" in option else ("--out", tmp_path / "out")
    code, _, err = ldo(capsys, "batch", "synthetic:room", *where, *option)
    assert code == 2
    assert message in err
    assert "Traceback" not in err
    assert [line[:5] for line in err.splitlines()] == [
        "ldo: "
    ]  # This is all: the command looked up no recording.


def test_interrupted_batch_keeps_finished_results_and_leaves_no_process(
    night: Path, tmp_path: Path
) -> None:
    where = tmp_path / "out"
    # The second recording takes minutes, and is interrupted.
    words = "batch", night / "desk", "synthetic:flat", "--out", where, "--workers", "2"
    with started(tmp_path / "log", *words, "--set", "mapper.iterations=1") as batch:
        batch.wait_until(lambda: "desk done" in batch.log and list(where.glob(".staging/job-*")))
        assert batch.end_with(signal.SIGTERM) == 130
        assert "ldo: interrupted; partial results are kept." in batch.log
        assert "Traceback" not in batch.log
    report = json.loads((where / "batch.json").read_text())
    assert [row["status"] for row in report["recordings"]] == ["done", "missing"]
    assert report["is_interrupted"]
    assert [path.parent.name[:5] for path in where.rglob("result.json")] == ["desk-"]
    assert not list(where.glob(".staging/job-*"))
    assert not _processes_with(str(where))


def _processes_with(text: str) -> list[str]:
    """Return the command lines and environments of processes that mention a text."""
    for _ in range(50):
        found = []
        for path in Path("/proc").glob("[0-9]*/fd"):
            try:
                found += [str(link) for link in path.iterdir() if text in str(link.readlink())]
            except OSError:
                continue
        if not found:
            break
        time.sleep(0.1)
    return found


def test_estimate_is_proportional_to_the_sizes(monkeypatch: pytest.MonkeyPatch, capsys) -> None:
    from rich.console import Console

    from ldo_service.batch import BatchJob, Recording
    from ldo_service.batch.job import Outcome, RunPlan
    from ldo_service.config import load_config

    now_s = iter([0.0, 0.0, 100.0])
    monkeypatch.setattr(time, "perf_counter", lambda: next(now_s))
    plan = RunPlan(config=load_config(None, ()))
    jobs = [
        BatchJob(
            recording=Recording(name, name, size, ""),
            plan=plan,
            out="",
            folder=name,
            key="",
            staging="",
        )
        for name, size in (("small", 10), ("large", 60))
    ]
    progress = _Progress(Console(), 2)
    progress.begin(jobs)
    progress.add(Outcome(source="small", name="small", folder="small", status="failed", error="x"))
    assert "1 of 2: small failed: x; about 10 min left" in capsys.readouterr().out


def test_page_without_results_is_valid() -> None:
    assert "no recordings" in page(report_of([], 0.0, is_interrupted=False))
