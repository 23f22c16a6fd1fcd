"""Loops that are closed between places half a metre apart: none is believed, and none shows."""

import json
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from ldo_service.config import actor_parameters, load_config
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.geometry import Trajectory
from ldo_service.runs.offline import run_offline

from .false_closures import MistakenLoopCloser, standing_in
from .jobs import ROUGH, job

SHARES = (0.3, 0.5, 0.75, 0.98)  # of the way, where a loop is closed that is none
APART_FRAMES, APART_M = 100, 0.5
MAX_WORSE = 1.1  # times the error without them

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@dataclass(frozen=True)
class Kept:
    """keyframe, frame_index and T_map_camera of each, and the ATE of all frames."""

    keyframes: list[dict]
    closures: list[dict]
    ate_m: float


@pytest.fixture(scope="module")
def kitchen(data: Path) -> Sequence:
    return open_sequence(str(data / "tum/kitchen"))


def run(kitchen: Sequence, folder: Path) -> Kept:
    run_offline(job(kitchen, folder), lambda *_: None)
    keyframes, loops = (
        json.loads((folder / name).read_text()) for name in ("keyframes.json", "loops.json")
    )
    truth, final = kitchen.truth(), Trajectory.load(folder / "trajectory.txt")
    assert truth is not None
    return Kept(keyframes, loops["closures"], evaluate_trajectory(final, truth).ate_m.rmse)


def half_a_meter_apart(keyframes: list[dict]) -> dict[int, int]:
    """Keyframes of four stretches of the way, each with an old one about so far from it."""
    found = {}
    for share in SHARES:
        new = keyframes[int(share * (len(keyframes) - 1))]
        old = [k for k in keyframes if k["frame_index"] < new["frame_index"] - APART_FRAMES]
        gaps_m = [np.linalg.norm(position(k) - position(new)) for k in old]
        nearest = int(np.argmin(np.abs(np.array(gaps_m) - APART_M)))
        found[new["keyframe"]] = old[nearest]["keyframe"]
    return found


def position(keyframe: dict) -> np.ndarray:
    return np.array(keyframe["T_map_camera"])[:3, 3]


def test_four_false_closures_are_not_believed(kitchen: Sequence, tmp_path: Path) -> None:
    without = run(kitchen, tmp_path / "without")
    pairs = half_a_meter_apart(without.keyframes)
    assert len(pairs) == len(SHARES)
    same = {new: (old, np.eye(4)) for new, old in pairs.items()}
    parameters = actor_parameters(load_config(settings=(ROUGH,)))
    with standing_in(MistakenLoopCloser(parameters.loop_closer, same)):
        planted = run(kitchen, tmp_path / "planted")
    told = {(c["reference"], c["keyframe"]): c["is_believed"] for c in planted.closures}
    false = {(old, new) for new, old in pairs.items()}
    assert false <= told.keys()
    assert not any(told[pair] for pair in false)
    assert sum(told.values()) > 0, "the true ones are believed as before"
    assert planted.ate_m < MAX_WORSE * without.ate_m
