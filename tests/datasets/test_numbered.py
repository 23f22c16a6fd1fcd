from pathlib import Path

import pytest

from ldo_service.datasets.files import numbered, pair_by_number
from ldo_service.errors import DataError


def test_only_whole_names_that_match_are_numbered(tmp_path: Path) -> None:
    for name in ("7.png", "07.jpg", "8.png.part", "a9.png", "10.png"):
        (tmp_path / name).touch()
    assert numbered(tmp_path, r"(\d+)\.png") == {7: tmp_path / "7.png", 10: tmp_path / "10.png"}
    assert numbered(tmp_path / "nowhere", r"(\d+)\.png") == {}


def test_frames_are_the_numbers_that_color_and_depth_share(tmp_path: Path) -> None:
    color = {k: Path(f"c{k}") for k in (30, 2, 10)}
    depth = {k: Path(f"d{k}") for k in (10, 30, 4)}
    frames = pair_by_number(color, depth, tmp_path)
    assert frames.numbers.tolist() == [10, 30]
    assert (frames.color, frames.depth) == ([color[10], color[30]], [depth[10], depth[30]])
    assert frames.stamps_ns.tolist() == [333_333_333, 1_000_000_000]
    with pytest.raises(DataError, match="1 color and 1 depth images"):
        pair_by_number({1: Path("c1")}, {2: Path("d2")}, tmp_path)
