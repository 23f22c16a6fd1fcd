"""Simulation of the actor graph on a logical clock, with digests of all messages."""

import json
import time
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path

import numpy as np
import pytest

from ldo_service.actors.frame_source import FrameSource
from ldo_service.actors.mapper import Mapper
from ldo_service.actors.mapper_config import MapperConfig
from ldo_service.actors.topology import GRAPH
from ldo_service.actors.tracker import Tracker
from ldo_service.config import load_config
from ldo_service.datasets import Cached, Sequence, open_sequence
from ldo_service.errors import DataError, FrameError
from ldo_service.geometry import RawFrame
from ldo_service.runs.simulation import ActorDigest, simulate_graph
from ldo_service.runs.source import Selection
from ldo_service.schemas import Keyframe
from tests.actors.conftest import camera_messages, handle_all
from tests.commands.test_cli import ldo
from tests.detection.networks import squares_network

from .jobs import ROUGH

FRAMES = 18


def simulated(sequence: Sequence, *settings: str) -> dict[str, ActorDigest]:
    config = load_config(settings=(ROUGH, *settings))
    return simulate_graph(sequence, config, Selection(max_frames=FRAMES), print, lambda _done: None)


@pytest.fixture(scope="module")
def digests_of_room(room: Sequence) -> dict[str, ActorDigest]:
    return simulated(room, "mapper.threads=1")


def test_every_actor_has_a_digest(digests_of_room: dict[str, ActorDigest]) -> None:
    assert list(digests_of_room) == [box.name for box in GRAPH]
    assert digests_of_room["frame_source"].messages == FRAMES
    publishing = [entry.digest for entry in digests_of_room.values() if entry.messages]
    assert len(publishing) >= 5
    assert len(set(publishing)) == len(publishing)


@pytest.mark.parametrize("threads", [2, 5])
def test_digests_do_not_depend_on_threads(
    room: Sequence, digests_of_room: dict[str, ActorDigest], threads: int
) -> None:
    assert simulated(room, f"mapper.threads={threads}") == digests_of_room


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


def test_one_pixel_changes_the_digests(
    room: Sequence, digests_of_room: dict[str, ActorDigest]
) -> None:
    changed = simulated(OnePixel(room))
    assert changed["frame_source"].digest != digests_of_room["frame_source"].digest
    assert changed["frame_source"].messages == digests_of_room["frame_source"].messages


def test_one_inverted_pixel_of_a_keyframe_reaches_tracker_and_map(
    room: Sequence, digests_of_room: dict[str, ActorDigest]
) -> None:
    changed = simulated(OnePixel(room, frame=0, bits=255))
    for actor in ("frame_source", "tracker", "mapper"):
        assert changed[actor].digest != digests_of_room[actor].digest, actor


def test_latency_of_an_actor_changes_the_digests(
    room: Sequence, digests_of_room: dict[str, ActorDigest]
) -> None:
    later = simulated(room, "offline.latency_frames.optimizer=6")
    assert later["frame_source"] == digests_of_room["frame_source"]
    assert later["tracker"] != digests_of_room["tracker"]


def helper_ratios() -> tuple[float, float]:
    """Return the fraction of CPU time that other threads spend during mapping.

    Returns:
        The fraction for mappers with one thread and with eight threads.
    """
    messages = camera_messages(open_sequence("synthetic:room"), range(FRAMES))
    frames = handle_all(FrameSource(), messages)
    keyframes = [out for out in handle_all(Tracker(), frames) if isinstance(out, Keyframe)]
    assert len(keyframes) > 1

    def helper_ratio(threads: int) -> float:
        mapper = Mapper(MapperConfig(threads=threads, iterations=1))
        whole_s, own_s = time.process_time(), time.thread_time()
        for keyframe in keyframes:
            list(mapper.handle(keyframe))
        whole_s, own_s = time.process_time() - whole_s, time.thread_time() - own_s
        return 1 - own_s / whole_s

    # The error of the clock and threads that only wait take longer at some times.
    return min(helper_ratio(1) for _ in range(3)), helper_ratio(8)


def test_the_renderer_uses_the_threads_it_is_given() -> None:
    """A new process measures, because threads of earlier tests would count too."""
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as processes:
        with_one, with_eight = processes.submit(helper_ratios).result()
    assert with_one == pytest.approx(0, abs=0.01)
    assert with_eight > 0.02  # Independent of the speed of the threads.


def test_source_without_readable_frames_is_bad_data(room: Sequence) -> None:
    class Unreadable(Cached):
        def read(self, index: int) -> RawFrame:
            raise FrameError(f"frame {index} is truncated.")

    with pytest.raises(DataError, match=r"none of the selected frames of .* could be used"):
        simulated(Unreadable(room))


def test_last_line_of_output_is_json(capsys: pytest.CaptureFixture[str]) -> None:
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
    """Settings of a detector of red, green and blue squares with a low minimum score."""
    path = tmp_path_factory.mktemp("model") / "squares.onnx"
    model = squares_network("yolov5", width=320, height=256).write(path)
    return f"detector.model={model}", "detector.min_score=0.02"


def test_a_labelled_map_does_not_depend_on_threads(
    room: Sequence, squares: tuple[str, ...], digests_of_room: dict[str, ActorDigest]
) -> None:
    one, two = (simulated(room, *squares, f"mapper.threads={threads}") for threads in (1, 2))
    assert one == two
    assert one["detector"].digest != digests_of_room["detector"].digest
    assert one["mapper"].digest != digests_of_room["mapper"].digest
    for same in ("tracker", "optimizer"):
        assert one[same] == digests_of_room[same], "labels do not reach other actors"
