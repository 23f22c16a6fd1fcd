"""False loop closures between places half a meter apart, which the pose graph rejects."""

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

from .false_closures import MistakenLoopCloser, replaced_actors
from .jobs import ROUGH, job

POSITION_RATIOS = (0.3, 0.5, 0.75, 0.98)  # Fractions of the keyframes before each false closure.
APART_FRAMES, APART_M = 100, 0.5
MAX_ERROR_RATIO = 1.1  # Relative to the error without false closures.

pytestmark = [pytest.mark.slow, pytest.mark.timeout(900)]


@dataclass(frozen=True)
class RunResult:
    """Keyframes and closures as a run wrote them, and the ATE of all frames."""

    keyframes: list[dict]
    closures: list[dict]
    ate_m: float


@pytest.fixture(scope="module")
def kitchen(data: Path) -> Sequence:
    return open_sequence(str(data / "tum/kitchen"))


def run(kitchen: Sequence, folder: Path) -> RunResult:
    run_offline(job(kitchen, folder), lambda *_: None)
    keyframes, loops = (
        json.loads((folder / name).read_text()) for name in ("keyframes.json", "loops.json")
    )
    truth, final = kitchen.truth(), Trajectory.load(folder / "trajectory.txt")
    assert truth is not None
    return RunResult(keyframes, loops["closures"], evaluate_trajectory(final, truth).ate_m.rmse)


def pairs_half_a_meter_apart(keyframes: list[dict]) -> dict[int, int]:
    """Return keyframes along the trajectory, each with an old one about half a meter away."""
    found = {}
    for ratio in POSITION_RATIOS:
        new = keyframes[int(ratio * (len(keyframes) - 1))]
        old = [k for k in keyframes if k["frame_index"] < new["frame_index"] - APART_FRAMES]
        gaps_m = [np.linalg.norm(position(k) - position(new)) for k in old]
        nearest = int(np.argmin(np.abs(np.array(gaps_m) - APART_M)))
        found[new["keyframe"]] = old[nearest]["keyframe"]
    return found


def position(keyframe: dict) -> np.ndarray:
    return np.array(keyframe["T_map_camera"])[:3, 3]


def test_four_false_closures_are_rejected(kitchen: Sequence, tmp_path: Path) -> None:
    without = run(kitchen, tmp_path / "without")
    pairs = pairs_half_a_meter_apart(without.keyframes)
    assert len(pairs) == len(POSITION_RATIOS)
    identity_closures = {new: (old, np.eye(4)) for new, old in pairs.items()}
    parameters = actor_parameters(load_config(settings=(ROUGH,)))
    with replaced_actors(MistakenLoopCloser(parameters.loop_closer, identity_closures)):
        planted = run(kitchen, tmp_path / "planted")
    is_accepted = {(c["reference"], c["keyframe"]): c["is_believed"] for c in planted.closures}
    false_pairs = {(old, new) for new, old in pairs.items()}
    assert false_pairs <= is_accepted.keys()
    assert not any(is_accepted[pair] for pair in false_pairs)
    assert sum(is_accepted.values()) > 0, "true closures are still accepted"
    assert planted.ate_m < MAX_ERROR_RATIO * without.ate_m
