"""Sources of a batch: paths, folders, patterns, lists, and their digests."""

from pathlib import Path

import fsspec
import pytest

from ldo_service.batch.sources import find_recordings, listed, measure
from ldo_service.errors import ConfigError, DataError
from tests.batch.slices import write_slice


@pytest.fixture
def night(room_folder: Path, tmp_path: Path) -> Path:
    """Return a folder with two recordings and a file of notes, which is no recording."""
    for name in ("a", "b"):
        write_slice(room_folder, tmp_path / "night" / name, 0, 2)
    (tmp_path / "night/notes.txt").touch()
    return tmp_path / "night"


@pytest.mark.parametrize("word", ["", "/*", "/[ab]"])
def test_folder_and_pattern_stand_for_the_recordings_in_them(night: Path, word: str) -> None:
    notes: list[str] = []
    assert list(find_recordings([f"{night}{word}"], notes.append)) == [f"{night}/a", f"{night}/b"]
    assert any("1 of 3 entries are not recordings" in note for note in notes) == (word != "/[ab]")


def test_recording_is_not_expanded_and_runs_once(night: Path) -> None:
    notes: list[str] = []
    words = [f"{night}/b", "synthetic:room", f"{night}/../night/b/", str(night)]
    found = find_recordings(words, notes.append)
    assert [source for source in found if "synthetic" in source] == ["synthetic:room"]
    assert sum(source.endswith("/a") for source in found) == 1
    assert any("given twice" in note for note in notes)


def test_layout_of_a_folder_in_a_bucket_is_recognized_by_its_names(night: Path) -> None:
    bucket = fsspec.filesystem("memory")
    bucket.put(f"{night}/", "/robots/night", recursive=True)
    bucket.pipe_file("/robots/drive.mcap", b"")
    notes: list[str] = []
    found = find_recordings(["memory://robots", "memory://robots/night/*"], notes.append)
    assert list(found) == [
        "memory:///robots/drive.mcap",
        *(f"memory:///robots/night/{n}" for n in "ab"),
    ]
    bucket.rm("/robots", recursive=True)


def test_wrong_word_is_an_error_of_its_own_unless_all_are_wrong(
    night: Path, tmp_path: Path
) -> None:
    (tmp_path / "empty").mkdir()
    wrong = {
        str(tmp_path / "absent"): "does not exist",
        f"{tmp_path}/absent/*": "no recording matches",
        str(tmp_path / "empty"): "is not a recording and contains none",
        "s3x://bucket": "the protocol s3x:// is unknown",
    }
    found = find_recordings([*wrong, str(night / "a")], pytest.fail)
    assert found.pop(str(night / "a")) is None
    assert found.keys() == wrong.keys()
    for word, text in wrong.items():
        assert text in str(found[word])
        with pytest.raises((DataError, ConfigError)):
            find_recordings([word], pytest.fail)


def test_list_is_relative_to_its_own_folder(tmp_path: Path) -> None:
    (tmp_path / "list.txt").write_text("# night\n a \n\n/b\ns3://c/d\nsynthetic:room\n~/e\n")
    expected = [str(tmp_path / "a"), "/b", "s3://c/d", "synthetic:room", "~/e"]
    assert listed(tmp_path / "list.txt") == expected
    with pytest.raises(ConfigError, match="cannot be read"):
        listed(tmp_path / "absent.txt")


def test_digest_depends_on_names_and_contents_and_not_on_the_path(night: Path) -> None:
    a, b = measure(str(night / "a")), measure(str(night / "b"))
    assert (a.content, a.size_bytes) == (b.content, b.size_bytes)
    assert (a.name, b.name) == ("a", "b")
    depth = night / "b/depth.txt"
    depth.write_text(depth.read_text().replace("3", "4"))
    assert depth.stat().st_size == (night / "a/depth.txt").stat().st_size
    assert measure(str(night / "b")).content != a.content
    (night / "a/rgb.txt").rename(night / "a/color.txt")
    assert measure(str(night / "a")).content != a.content


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("my bag#1.mcap", "my-bag-1"),
        (".hidden", "hidden"),
        ("übung.bag", "übung"),
        ("x" * 90, "x" * 60),
    ],
)
def test_name_is_usable_as_the_name_of_a_folder(tmp_path: Path, source: str, name: str) -> None:
    (tmp_path / source).touch()
    assert measure(str(tmp_path / source)).name == name
