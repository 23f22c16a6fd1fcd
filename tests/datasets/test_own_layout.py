"""The example of a layout in another package works as the page says."""

import runpy
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Layout, SequenceOptions, open_sequence
from ldo_service.errors import DataError

EXAMPLE = Path(__file__).parents[2] / "examples" / "own_layout.py"
PAGE = Path(__file__).parents[2] / "docs" / "own-layout.md"


@pytest.fixture
def layout() -> Layout:
    return runpy.run_path(str(EXAMPLE))["LAYOUT"]


def test_example_reads_the_frames_of_a_file(layout: Layout, tmp_path: Path) -> None:
    room = open_sequence("synthetic:room")
    frames = [room.read(index) for index in range(3)]
    path, camera = tmp_path / "desk.npz", room.raw_camera
    np.savez(
        path,
        color=[frame.color for frame in frames],
        depth_mm=[np.round(1000 * frame.depth_m()).astype(np.uint16) for frame in frames],
        stamps_ns=room.stamps_ns[:3],
        camera=[camera.width, camera.height, camera.fx, camera.fy, camera.cx, camera.cy],
    )
    assert layout.matches(path)
    sequence = layout.open_sequence(path, SequenceOptions())
    assert (sequence.name, len(sequence), sequence.raw_camera) == ("desk", 3, camera)
    np.testing.assert_array_equal(sequence.read(2).color, frames[2].color)
    np.testing.assert_allclose(sequence.read(2).depth_m(), frames[2].depth_m(), atol=6e-4)


def test_example_names_a_damaged_file(layout: Layout, tmp_path: Path) -> None:
    path = tmp_path / "desk.npz"
    path.write_bytes(b"no archive")
    with pytest.raises(DataError, match=r"desk\.npz cannot be read.*color"):
        layout.open_sequence(path, SequenceOptions())


def test_page_includes_the_example_and_it_has_at_most_40_lines() -> None:
    """The fence must not be named `python`: ruff would format the inclusion as a program."""
    assert '```{ .python }\n--8<-- "examples/own_layout.py"\n```' in PAGE.read_text()
    lines = [line for line in EXAMPLE.read_text().splitlines() if line.strip()]
    assert len(lines) <= 40
