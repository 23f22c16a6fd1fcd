"""Descriptions of sources of frames."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.datasets import Sequence, open_sequence
from ldo_service.errors import FrameError
from ldo_service.geometry import RawFrame, Trajectory
from ldo_service.runs.source import layout_of
from ldo_service.runs.source_info import describe, estimated_run_s
from tests.datasets.bags import entries_of, write_bag
from tests.runs.jobs import job


class Gaps(Sequence):
    """The room without some frames, with late depth; one frame cannot be read."""

    def __init__(self, room: Sequence, kept: list[int]) -> None:
        camera = replace(room.raw_camera, distortion=(0.1, 0.0, 0.0, 0.0))
        super().__init__("gaps", camera, room.stamps_ns[kept])
        self._room, self._kept = room, kept
        self.depth_offsets_ns = np.full(len(kept), 4_000_000)
        self.depth_offsets_ns[2:3] = -9_000_000

    def read(self, index: int) -> RawFrame:
        if index == 0:
            raise FrameError("damaged")
        raw = replace(self._room.read(self._kept[index]), camera=self.raw_camera)
        depth = raw.depth.copy()
        depth[: len(depth) // 4] = 0
        return replace(raw, depth=depth)

    def truth(self) -> Trajectory | None:
        return None


def test_gaps_offsets_and_valid_depth_are_measured(room: Sequence) -> None:
    kept = [*range(10), *range(13, 20), *range(25, 30)]
    found = describe(Gaps(room, kept))
    timing, depth = found.timing, found.depth
    assert (timing.frames, timing.gaps) == (22, 2)
    assert timing.rate_hz == pytest.approx(30)
    assert timing.longest_interval_s == pytest.approx(0.2)
    assert timing.duration_s == pytest.approx(29 / 30)
    assert (depth.offset_ms, depth.max_offset_ms) == (4.0, 9.0)
    assert depth.valid_ratio == pytest.approx(0.75)
    assert depth.median_m == pytest.approx(2.9, abs=0.5)
    assert (found.sampled_frames, found.unreadable_frames) == (5, 1)
    assert found.camera["distortion"] == (0.1, 0.0, 0.0, 0.0)
    assert (found.true_poses, found.has_true_labels) == (0, False)


def test_empty_and_single_frames_are_described(room: Sequence) -> None:
    empty, single = (describe(Gaps(room, kept)) for kept in ([], [3, 4, 5]))
    assert (empty.timing.frames, empty.timing.rate_hz, empty.depth.valid_ratio) == (0, None, None)
    assert single.timing.gaps == 0


def test_layout_is_named(
    room: Sequence, tmp_path: Path, room_folder: Path, recording: Path
) -> None:
    # The name of this bag is that of a file of a recording.
    bag = write_bag(tmp_path, "mcap", entries_of(room, range(1, 4)), "frame_source")
    expected = {
        str(room_folder): "TUM RGB-D",
        str(bag): "a bag of ROS",
        str(recording): "a recording of `ldo record`",
        "synthetic:room": "a built-in scene",
        str(tmp_path): "none",
    }
    for source, layout in expected.items():
        assert layout_of(source) == layout
    assert len(open_sequence(str(bag))) == 3
    assert describe(open_sequence(str(recording))).depth.registration == "source"


def test_probe_estimates_the_time_of_a_run(room: Sequence, tmp_path: Path) -> None:
    config = job(room, tmp_path / "run").config
    assert estimated_run_s(room, config, 2) > 0
