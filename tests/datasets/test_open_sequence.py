from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from ldo_service.conversions.frames import raw_frame_from_message, raw_frame_to_message
from ldo_service.datasets import Layout, SequenceOptions, layout, open_sequence
from ldo_service.errors import ConfigError, DataError
from ldo_service.schemas import CameraRgbd, decode, encode
from ldo_service.synthetic import SCENES

from .recordings import (
    small_frames,
    write_nerfstudio,
    write_open3d,
    write_r3d,
    write_sens,
    write_stray,
)


def test_synthetic_without_a_name_is_the_room() -> None:
    assert open_sequence("synthetic").name == open_sequence("synthetic:room").name


def test_unknown_synthetic_name_lists_the_known_ones() -> None:
    with pytest.raises(DataError, match=r"synthetic:castle.*synthetic:room"):
        open_sequence("synthetic:castle")


def test_error_and_page_list_every_built_in_scene() -> None:
    page = (Path(__file__).parents[2] / "docs/first-steps.md").read_text()
    with pytest.raises(DataError) as caught:
        open_sequence("synthetic:castle")
    assert all(name in str(caught.value) for name in SCENES)
    assert all(f"`synthetic:{name}`" in page for name in SCENES)


def test_folder_of_recordings_names_one_of_them(tum_folder: Callable[..., Path]) -> None:
    recording = tum_folder(["1"], ["1"])
    with pytest.raises(DataError, match=f"such as {recording}, or give the folder to `ldo batch`"):
        open_sequence(str(recording.parent))


def test_unknown_folder_is_a_short_error_with_its_content(tmp_path: Path) -> None:
    for name in ("c.txt", "a.txt", ".hidden", "b.txt", "d.txt"):
        (tmp_path / name).touch()
    with pytest.raises(DataError) as caught:
        open_sequence(str(tmp_path))
    assert "it contains a.txt, b.txt, c.txt and 1 more." in str(caught.value)
    assert len(str(caught.value).replace(str(tmp_path), "")) < 360


def test_folder_with_several_sequences_of_7_scenes_names_one_of_them(
    seven_scenes_folder: Callable[..., Path],
) -> None:
    folder = seven_scenes_folder([0, 1])
    with pytest.raises(DataError, match=f"Give one of them, such as {folder}"):
        open_sequence(str(folder.parent))


def test_seed_after_the_name_is_part_of_the_name() -> None:
    plain, other = (open_sequence(f"synthetic:room{seed}") for seed in ("@0", "@3"))
    assert (plain.name, other.name) == ("synthetic:room", "synthetic:room@3")
    assert plain[0].color.tobytes() != other[0].color.tobytes()
    assert open_sequence("synthetic:flat-exact@2").name == "synthetic:flat-exact@2"


@pytest.mark.parametrize("seed", ["@", "@x", "@-1", "@1.5"])
def test_invalid_seed_is_rejected(seed: str) -> None:
    with pytest.raises(DataError, match="as in synthetic:room@3"):
        open_sequence(f"synthetic:room{seed}")


def test_folder_of_unknown_layout_names_the_known_layouts(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("")
    with pytest.raises(DataError, match=r"no known layout.*TUM.*Replica.*ScanNet.*7-Scenes") as e:
        open_sequence(str(tmp_path))
    assert len(str(e.value)) < 700


def test_error_for_a_folder_with_a_file_of_a_layout_names_its_other_files(tmp_path: Path) -> None:
    (tmp_path / "rgb.txt").write_text("")
    with pytest.raises(
        DataError, match=r"Expected rgb.txt and depth.txt \(TUM RGB-D\)\. docs/first"
    ):
        open_sequence(str(tmp_path))


def test_missing_folder_and_file_have_different_messages(tmp_path: Path) -> None:
    with pytest.raises(DataError, match=r"nowhere does not exist.*synthetic:room"):
        open_sequence(str(tmp_path / "nowhere"))
    (tmp_path / "a.txt").touch()
    with pytest.raises(DataError, match=r"the file .*no known layout"):
        open_sequence(str(tmp_path / "a.txt"))


def test_every_message_is_one_paragraph(tmp_path: Path) -> None:
    with pytest.raises(DataError) as caught:
        open_sequence(str(tmp_path))
    assert "\n" not in str(caught.value)


def test_indices_outside_the_sequence_are_rejected() -> None:
    room = open_sequence("synthetic")
    for index in (-1, len(room)):
        with pytest.raises(IndexError, match="frames 0 to 119"):
            room[index]


def test_registration_is_rejected_where_depth_is_registered_already(
    tum_folder: Callable[..., Path], replica_folder: Callable[..., Path]
) -> None:
    for source in (tum_folder(["1"], ["1"]), replica_folder([0]), "synthetic:room"):
        with pytest.raises(ConfigError, match="registered to color already"):
            open_sequence(str(source), SequenceOptions(register_depth=True))


@pytest.mark.parametrize(
    "write",
    [
        lambda folder: write_stray(folder / "stray", small_frames(2), (32, 24)),
        lambda folder: write_r3d(folder / "a.r3d", small_frames(2), (32, 24)),
        lambda folder: write_nerfstudio(folder / "nerfstudio", small_frames(2), (32, 24)),
        lambda folder: write_sens(folder / "a.sens", small_frames(2)),
        lambda folder: write_open3d(folder / "open3d", small_frames(2)),
    ],
)
def test_frame_of_each_format_can_be_sent(write: Callable[[Path], Path], tmp_path: Path) -> None:
    raw = open_sequence(str(write(tmp_path))).read(1)
    body = encode(raw_frame_to_message(raw))
    found = raw_frame_from_message(decode(body, CameraRgbd), 1)
    assert (found.camera, found.stamp_ns) == (raw.camera, raw.stamp_ns)
    assert np.array_equal(found.depth, raw.depth)


def test_every_layout_says_where_depth_is_registered(
    tum_folder: Callable[..., Path],
    replica_folder: Callable[..., Path],
    scannet_folder: Callable[..., Path],
    seven_scenes_folder: Callable[..., Path],
) -> None:
    moved = np.eye(4)
    moved[0, 3] = 0.02
    seven_scenes = str(seven_scenes_folder([0, 1]))
    assert open_sequence(str(tum_folder(["1"], ["1.01"]))).registration == "source"
    assert open_sequence(str(replica_folder([0]))).registration == "source"
    assert open_sequence(str(scannet_folder([0, 1], moved))).registration == "reader"
    assert open_sequence(seven_scenes).registration == "none"
    registered = open_sequence(seven_scenes, SequenceOptions(register_depth=True))
    assert registered.registration == "reader"


def test_stamps_of_depth_are_kept(tum_folder: Callable[..., Path]) -> None:
    offsets_ns = open_sequence(str(tum_folder(["1", "2"], ["1.01", "1.995"]))).depth_offsets_ns
    assert offsets_ns is not None
    assert offsets_ns.tolist() == [10_000_000, -5_000_000]


# --- layouts of other packages --------------------------------------------------------------------
class Registered:
    """An entry point of another package."""

    name, value = "mine", "my_package:LAYOUT"

    def __init__(self, loaded: object) -> None:
        self._loaded = loaded

    def load(self) -> object:
        if isinstance(self._loaded, Exception):
            raise self._loaded
        return self._loaded


@pytest.fixture
def register(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[object], None]]:
    """Return a function that registers an object as a layout of another package."""

    def registers(loaded: object) -> None:
        layout.registered_layouts.cache_clear()
        points = [Registered(loaded)]
        monkeypatch.setattr(layout, "entry_points", lambda group: points if group else [])

    yield registers
    layout.registered_layouts.cache_clear()


def test_layout_of_another_package_opens_its_files(
    register: Callable[[object], None], tmp_path: Path
) -> None:
    path = tmp_path / "desk.mine"
    path.write_text("")
    room = open_sequence("synthetic:room")
    register(Layout("my rig", "*.mine", lambda path: path.suffix == ".mine", lambda *_: room))
    assert open_sequence(str(path)) is room
    with pytest.raises(ConfigError, match=r"my rig.*registration options"):
        open_sequence(str(path), SequenceOptions(register_depth=True))
    (tmp_path / "other").touch()
    with pytest.raises(DataError, match=r"no known layout.*my rig"):
        open_sequence(str(tmp_path / "other"))


@pytest.mark.parametrize(
    ("loaded", "message"),
    [(ImportError("no module"), "cannot be loaded: ImportError: no module"), (3, "is a int")],
)
def test_entry_point_that_is_no_layout_is_named(
    register: Callable[[object], None], tmp_path: Path, loaded: object, message: str
) -> None:
    register(loaded)
    with pytest.raises(ConfigError, match=f"mine = my_package:LAYOUT.*{message}"):
        open_sequence(str(tmp_path))


def test_broken_layout_of_another_package_does_not_hide_known_ones(
    register: Callable[[object], None], seven_scenes_folder: Callable[..., Path]
) -> None:
    register(ImportError("no module"))
    assert len(open_sequence(str(seven_scenes_folder([0, 1])))) == 2
