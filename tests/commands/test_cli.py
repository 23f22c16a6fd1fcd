"""Output, errors and exit codes of the command line."""

import json
import resource
import subprocess
import sys
from pathlib import Path

import pytest

from ldo_service.commands import cli

LDO = (sys.executable, "-m", "ldo_service")


def ldo(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> tuple[int, str, str]:
    """Run a command in this process; return its exit code, output and error output."""
    try:
        cli.main([str(argument) for argument in arguments])
        code = 0
    except SystemExit as leaving:
        code = int(leaving.code or 0)
    captured = capsys.readouterr()
    return code, captured.out, captured.err


def assert_one_paragraph(text: str) -> None:
    assert text.startswith("ldo: ")
    assert "Traceback" not in text
    assert len(text.strip().splitlines()) == 1


def test_help_names_every_verb(capsys) -> None:
    code, out, _ = ldo(capsys, "--help")
    assert code == 0
    for verb in cli.verbs():
        assert f"\n  {verb} " in out


@pytest.mark.parametrize("verb", list(cli.verbs()))
def test_every_verb_has_a_help_text(capsys, verb: str) -> None:
    code, out, _ = ldo(capsys, verb, "--help")
    assert code == 0
    assert f"usage: ldo {verb}" in out


def test_help_omits_defaults_that_say_nothing(capsys) -> None:
    for verb in cli.verbs():
        _, out, _ = ldo(capsys, verb, "--help")
        assert "default: None" not in out
        assert "default: False" not in out
    _, out, _ = ldo(capsys, "run", "--help")
    assert "(default: 1)" in out
    assert "(required)" in out


@pytest.mark.parametrize(
    ("words", "part"),
    [
        ("run synthetic:room --out x --foo", "--foo"),
        ("run synthetic:room --out x --max-frame 3", "meant: --max-frames"),
        ("run synthetic:room", "--out DIR"),
        ("run synthetic:room --out x --stride many", "'many'"),
        ("run synthetic:room --out x --device tpu", "'tpu'"),
        ("keys", "init"),
    ],
)
def test_wrong_argument_points_to_the_help_of_the_verb(capsys, words: str, part: str) -> None:
    code, _, err = ldo(capsys, *words.split())
    assert code == 2
    assert_one_paragraph(err)
    assert part in err
    assert err.endswith(f"ldo {words.split()[0]} --help.\n")


def test_unknown_verb_names_the_nearest_one(capsys) -> None:
    code, _, err = ldo(capsys, "sreve")
    assert code == 2
    assert err == "ldo: there is no command 'sreve'. Did you mean serve?\n"


def test_a_missing_source_is_bad_data(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "run", str(tmp_path / "absent"), "--out", str(tmp_path / "out"))
    assert code == 3
    assert_one_paragraph(err)
    assert "does not exist" in err
    assert not (tmp_path / "out").exists()


def test_an_unknown_layout_is_bad_data(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "run", str(tmp_path), "--out", str(tmp_path / "out"))
    assert code == 3
    assert_one_paragraph(err)


@pytest.mark.parametrize(
    "arguments",
    [
        ("--stride", "0"),
        ("--max-frames", "-3"),
        ("--hold-out-every", "1"),
        ("--set", "mapper.nothing=1"),
        ("--threads", "-1"),
    ],
)
def test_bad_arguments_are_a_configuration_error(capsys, tmp_path: Path, arguments) -> None:
    out = str(tmp_path / "out")
    code, _, err = ldo(capsys, "run", "synthetic:room", "--out", out, *arguments)
    assert code == 2
    assert_one_paragraph(err)


@pytest.mark.parametrize("existing", [(), ("config.yaml",), ("config.yaml", "summary.json")])
def test_a_full_folder_is_refused_and_left_unchanged(capsys, tmp_path: Path, existing) -> None:
    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "thesis.tex").write_text("years of work")
    for name in existing:
        (tmp_path / name).write_text("{}")
    for extra in ((), ("--overwrite",)):
        code, _, err = ldo(capsys, "run", "synthetic:room", "--out", str(tmp_path), *extra)
        assert code == 2
        assert_one_paragraph(err)
    assert (tmp_path / "src" / "thesis.tex").read_text() == "years of work"
    assert all((tmp_path / name).read_text() == "{}" for name in existing)


def test_unwritable_folder_is_reported(capsys) -> None:
    code, _, err = ldo(capsys, "run", "synthetic:room", "--out", "/proc/nowhere")
    assert code == 2
    assert_one_paragraph(err)
    assert "cannot be written" in err


def test_full_disk_is_reported(capsys, tmp_path: Path) -> None:
    """A limit on the size of files makes a write fail, as a full disk does."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, hard))
    try:
        code, _, err = ldo(
            capsys, "run", "synthetic:room", "--out", str(tmp_path / "out"), "--max-frames", "5"
        )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert code == 2
    assert "cannot be written" in err
    assert "Traceback" not in err


def test_evaluating_a_folder_without_a_run_is_bad_data(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "eval", str(tmp_path), "synthetic:room")
    assert code == 3
    assert_one_paragraph(err)


def test_publishing_without_a_service_suggests_to_start_one(capsys) -> None:
    code, _, err = ldo(
        capsys, "publish", "synthetic:room", "--endpoint", "tcp/127.0.0.1:1", "--max-frames", "1"
    )
    assert code == 6
    assert_one_paragraph(err)
    assert "ldo serve" in err


def test_a_robot_name_that_breaks_topics_is_refused(capsys) -> None:
    code, _, err = ldo(capsys, "serve", "--robot", "a/b")
    assert code == 2
    assert_one_paragraph(err)


def test_debug_shows_the_traceback(tmp_path: Path) -> None:
    done = subprocess.run(
        [*LDO, "run", str(tmp_path), "--out", str(tmp_path / "o"), "--debug"],
        capture_output=True,
        text=True,
    )
    assert done.returncode != 0
    assert "Traceback" in done.stderr


def test_a_closed_pipe_is_no_error() -> None:
    done = subprocess.run(
        f"{sys.executable} -m ldo_service topics --json-schema | head -1",
        shell=True,
        capture_output=True,
        text=True,
    )
    assert done.stderr == ""


def test_bench_prints_one_json_object_or_a_table(capsys) -> None:
    small = ("bench", "render", "--gaussians", "300", "--size", "64x48", "--repeats", "2")
    code, out, _ = ldo(capsys, *small, "--threads", "2", "--gaussians-out-of-view", "500", "--json")
    assert code == 0
    facts = json.loads(out)
    steps = [facts[f"{step}_ms"] for step in ("forward", "loss", "backward", "adam")]
    assert all(time_ms >= 0 for time_ms in steps)
    assert facts["iteration_ms"] > 0
    assert facts["isa"] in ("baseline", "avx2", "avx512")
    wanted = {
        "gaussians": 300,
        "gaussians_out_of_view": 500,
        "width": 64,
        "height": 48,
        "threads": 2,
    }
    assert wanted.items() <= facts.items()
    code, out, _ = ldo(capsys, *small)
    assert code == 0
    assert "iteration" in out


@pytest.mark.parametrize("change", [("--size", "64"), ("--size", "0x3"), ("--threads", "0")])
def test_bench_refuses_invalid_arguments(capsys, change: tuple[str, str]) -> None:
    code, _, err = ldo(capsys, "bench", "render", *change)
    assert code == 2
    assert_one_paragraph(err)
