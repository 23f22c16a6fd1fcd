"""The graph on the logical clock: digests that depend on the input alone."""

import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ldo_service.actors.mapper import Mapper, MapperConfig
from ldo_service.actors.topology import GRAPH
from ldo_service.config import load_config
from ldo_service.datasets import Cached, Sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import RawFrame
from ldo_service.runs.simulation import ActorDigest, simulate_graph
from ldo_service.runs.source import Selection
from ldo_service.schemas import Keyframe
from tests.actors.conftest import frames, keyframes, tracked  # noqa: F401
from tests.commands.test_cli import ldo
from tests.detection.networks import squares_network

from .jobs import ROUGH

FRAMES = 30


def simulated(sequence: Sequence, *settings: str) -> dict[str, ActorDigest]:
    config = load_config(settings=(ROUGH, *settings))
    return simulate_graph(sequence, config, Selection(max_frames=FRAMES), print, lambda _done: None)


@pytest.fixture(scope="module")
def made(room: Sequence) -> dict[str, ActorDigest]:
    return simulated(room)


def test_every_actor_has_a_digest(made: dict[str, ActorDigest]) -> None:
    assert list(made) == [box.name for box in GRAPH]
    assert made["frame_source"].messages == FRAMES
    talking = [entry.digest for entry in made.values() if entry.messages]
    assert len(talking) >= 5
    assert len(set(talking)) == len(talking)


@pytest.mark.parametrize("threads", [1, 2, 5])
def test_digests_do_not_depend_on_threads(
    room: Sequence, made: dict[str, ActorDigest], threads: int
) -> None:
    assert simulated(room, f"mapper.threads={threads}") == made


class OnePixel(Cached):
    """A sequence with some bits of one pixel of one frame flipped."""

    def __init__(self, sequence: Sequence, frame: int = FRAMES // 2, bits: int = 1) -> None:
        super().__init__(sequence)
        self._frame, self._bits = frame, bits

    def read(self, index: int) -> RawFrame:
        raw = super().read(index)
        if index != self._frame:
            return raw
        color = np.array(raw.color)
        color[100, 100, 1] ^= self._bits
        return replace(raw, color=color)


def test_one_pixel_changes_the_digests(room: Sequence, made: dict[str, ActorDigest]) -> None:
    changed = simulated(OnePixel(room))
    assert changed["frame_source"].digest != made["frame_source"].digest
    assert changed["frame_source"].messages == made["frame_source"].messages


def test_one_inverted_pixel_of_a_keyframe_reaches_tracker_and_map(
    room: Sequence, made: dict[str, ActorDigest]
) -> None:
    changed = simulated(OnePixel(room, frame=0, bits=255))
    for actor in ("frame_source", "tracker", "mapper"):
        assert changed[actor].digest != made[actor].digest, actor


def test_the_latency_is_an_input(room: Sequence, made: dict[str, ActorDigest]) -> None:
    later = simulated(room, "offline.latency_frames.optimizer=6")
    assert later["frame_source"] == made["frame_source"]
    assert later["tracker"] != made["tracker"]


def test_the_renderer_uses_the_threads_it_is_given(
    keyframes: list[Keyframe],  # noqa: F811
) -> None:
    def share_of_helpers(threads: int) -> float:
        """CPU time that threads other than this one spend while it maps."""
        mapper = Mapper(MapperConfig(threads=threads, iterations=1))
        whole_s, own_s = time.process_time(), time.thread_time()
        for keyframe in keyframes:
            list(mapper.handle(keyframe))
        whole_s, own_s = time.process_time() - whole_s, time.thread_time() - own_s
        return 1 - own_s / whole_s

    assert share_of_helpers(1) == pytest.approx(0, abs=0.01)  # the clock's own error
    assert share_of_helpers(8) > 0.02  # eight threads cannot hide; how fast they are is no matter


def test_nothing_readable_is_bad_data(room: Sequence) -> None:
    class Spoilt(Cached):
        def read(self, index: int) -> RawFrame:
            raise FrameError(f"frame {index} is truncated.")

    with pytest.raises(DataError, match="no frame"):
        simulated(Spoilt(room))


def test_the_last_line_is_json_for_scripts(capsys: pytest.CaptureFixture[str]) -> None:
    arguments = ("simulate", "synthetic:room", "--max-frames", "4", "--threads", "2", "--json")
    code, out, _ = ldo(capsys, *arguments)
    assert code == 0
    digests = json.loads(out.splitlines()[-1])
    assert digests["frame_source"]["messages"] == 4
    assert all(len(bytes.fromhex(entry["digest"])) == 16 for entry in digests.values())


@pytest.mark.slow
def test_real_frames_give_the_same_digests_for_one_thread_and_two(data: Path) -> None:
    from ldo_service.datasets import open_sequence

    kitchen = open_sequence(str(data / "tum" / "kitchen"))
    assert simulated(kitchen, "mapper.threads=1") == simulated(kitchen, "mapper.threads=2")


@pytest.fixture(scope="module")
def squares(tmp_path_factory: pytest.TempPathFactory) -> tuple[str, ...]:
    """Settings of a detector that finds what is red, green or blue, however pale."""
    path = tmp_path_factory.mktemp("model") / "squares.onnx"
    model = squares_network("yolov5", width=320, height=256).write(path)
    return f"detector.model={model}", "detector.min_score=0.02"


def test_a_labelled_map_does_not_depend_on_threads(
    room: Sequence, squares: tuple[str, ...], made: dict[str, ActorDigest]
) -> None:
    one, two = (simulated(room, *squares, f"mapper.threads={threads}") for threads in (1, 2))
    assert one == two
    assert one["detector"].digest != made["detector"].digest
    assert one["mapper"].digest != made["mapper"].digest
    for same in ("tracker", "optimizer"):
        assert one[same] == made[same], "labels reach nobody else"
