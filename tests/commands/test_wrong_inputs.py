"""Errors of all commands for wrong arguments, folders and files."""

from pathlib import Path

import pytest

from tests.commands.test_cli import assert_one_paragraph, ldo

SUITE = "title: x\nsequences: {a: nowhere}\nfigures: [ate_cm]\n"
ROS = "publish", "ros2", "--color", "/c/image_raw"


@pytest.fixture
def example_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with an empty, a full and an invalid folder, a run, a service state and files."""
    monkeypatch.chdir(tmp_path)
    for name in ("empty", "full", "junk", "ran", "kept/state"):
        (tmp_path / name).mkdir(parents=True)
    for name in ("ran/frames.csv", "ran/config.yaml", "kept/config.yaml"):
        (tmp_path / name).touch()
    (tmp_path / "full" / "thesis.tex").write_text("years of work")
    (tmp_path / "junk" / "tracker.mcap").write_bytes(b"no recording")
    (tmp_path / "suite.yaml").write_text(SUITE)
    (tmp_path / "broken.yaml").write_text("title: [\n\n  x: {")
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "code", "expected"),
    [
        ("suite nosuch --out s", 2, "no suite nosuch"),
        ("suite broken.yaml --out s", 2, "is not a suite"),
        ("suite suite.yaml --out s", 3, "none of the sequences of suite.yaml. Give their folder"),
        ("suite suite.yaml --out /proc/x", 2, "/proc/x cannot be written"),
        ("keys init full", 2, "full exists already"),
        (
            "keys list empty",
            2,
            "empty contains no certificate authority (No such file or directory)",
        ),
        ("keys router empty", 2, "access.yaml cannot be read"),
        ("eval empty synthetic:room", 3, "Give the folder of a finished `ldo run`"),
        ("query nowhere chair", 3, "nowhere is not a folder"),
        ("query empty chair", 3, "empty has no objects.json"),
        ("query kept chair", 3, "kept holds the state of a service"),
        ("publish nowhere", 3, "nowhere does not exist"),
        ("publish junk", 3, "junk holds no camera/rgbd"),
        ("publish realsense --size 3", 2, "--size 3"),
        ("publish realsense --size 0x480", 2, "--size 0x480"),
        ("publish realsense --rate 3", 2, "--rate applies to sequences"),
        ("publish ros2", 2, "needs --color TOPIC and --depth TOPIC"),
        ("publish ros2 --color /c/image_raw --depth /d/*", 2, "is not a valid ROS topic"),
        ("publish ros2 --color /c --depth /d --stride 0", 2, "--stride 0 and"),
        ("publish ros2 --color /c --depth /d --max-skew-s -1", 2, "--max-skew-s=-1"),
        ("record full", 2, "full is not empty"),
        ("serve --only tracker", 2, "--only is now --actor."),
        ("run x --out y --refine=5", 2, "--refine is now --refine-iterations."),
        ("record r --actor nobody", 2, "no actor 'nobody'"),
        ("record r --endpoint tcp/0.0.0.0:7447", 2, "--insecure"),
        ("record r --config broken.yaml", 2, "broken.yaml is not valid YAML"),
        ("record r --localize empty", 3, "no keyframe_database.msgpack"),
        ("run synthetic:room --out s --reuse-front-end empty", 3, "empty has no front_end.mcap"),
        (
            "run synthetic:room --out s --reuse-front-end s",
            2,
            "--out s is also the folder of --reuse-front-end",
        ),
        (
            "run synthetic:room --out s --reuse-front-end x --keep-front-end",
            2,
            "exclude each other",
        ),
        ("run synthetic:room --out s --realtime --keep-front-end", 2, "exclude each other"),
        ("simulate empty", 3, "has no known layout"),
        ("simulate junk", 3, "junk holds no camera/rgbd"),
        ("simulate synthetic:room --max-frames 0", 2, "--max-frames 0: both"),
        ("serve --localize nowhere", 3, "no keyframe_database.msgpack"),
        ("serve --state suite.yaml", 2, "cannot be used for state"),
        ("serve --resume ran", 2, "ran contains a run of `ldo run`"),
        ("serve --state junk", 2, "junk contains a recording"),
        ("serve --set tracker.nothing=1", 2, "no setting tracker.nothing"),
        ("serve --keys empty --endpoint tls/127.0.0.1:1", 2, "ca.crt cannot be read"),
        ("replay junk --verify", 3, "not an MCAP file"),
    ],
)
def test_wrong_input_is_reported_in_one_paragraph_with_its_exit_code(
    capsys, example_folders: Path, arguments: str, code: int, expected: str
) -> None:
    exit_code, _, err = ldo(capsys, *arguments.split())
    message = err.splitlines()[-1]
    assert_one_paragraph(message)
    assert expected in message
    assert exit_code == code
    assert (example_folders / "full" / "thesis.tex").read_text() == "years of work"


@pytest.mark.usefixtures("example_folders")
def test_router_with_keys_needs_the_bridge_option(capsys) -> None:
    assert ldo(capsys, "keys", "init", "keys")[0] == 0
    assert ldo(capsys, "keys", "add", "keys", "camera", "front")[0] == 0
    with_keys = "--keys", "keys/front", "--endpoint", "tls/127.0.0.1:1"
    code, _, err = ldo(capsys, *ROS, "--depth", "/d", *with_keys)
    assert code == 2
    assert "router's address with --bridge" in err
