"""Realtime runs with the stages of the service."""

import json
from pathlib import Path

from ldo_service.datasets import Sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.runs.realtime import run_realtime

from .jobs import job


def test_realtime_run_takes_sequence_time_and_accounts_for_every_frame(
    room: Sequence, tmp_path: Path
) -> None:
    frames = 45
    for index in range(frames):
        room.read(index)
    record = run_realtime(job(room, tmp_path / "out", frames=frames), lambda _done: None)
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["wall_s"] >= (frames - 1) / 30
    tracked = sum(summary["status"].values())
    assert tracked + sum(summary["drops"].values()) >= frames - 4, (
        "the rest came before the first keyframe"
    )
    assert summary["keyframes"] > 1
    assert "calibration_finished" in summary["calibration"]
    truth = room.truth()
    assert truth is not None
    assert evaluate_trajectory(record.online(), truth).ate_m.rmse < 0.01
