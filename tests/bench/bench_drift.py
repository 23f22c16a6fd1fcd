"""Accuracy with and without loop closing on drifting odometry, and actor time per correction.

    python -m tests.bench.bench_drift [SOURCE] [--scale 0.01] [--aside 0] [--turn 0.5] [--only RUN]
        [--set KEY=VALUE ...]

All actors run over SOURCE (synthetic:flat) with every fifth frame held out. There are three runs:
without drift, with drift, and with drift but without loop closing. The drift is a fraction --scale
of the path along it, a fraction --aside to one side of the world, and --turn degrees per meter.
`odometry` is the trajectory before corrections, and `online` is the one published during the run. A
pause is the maximum CPU time of an actor for one correction. The last column has the Gaussians in
memory at the end.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from ldo_service.actors.topology import make_actors
from ldo_service.config import Config, actor_parameters, load_config
from ldo_service.conversions.poses import pose_from_message
from ldo_service.datasets import Sequence, open_sequence
from ldo_service.evaluation.trajectory import evaluate_trajectory
from ldo_service.evaluation.views import EvaluatedFrames, evaluate_rendering
from ldo_service.geometry import Trajectory
from ldo_service.runs.finished import read_run
from ldo_service.runs.folder import prepare
from ldo_service.runs.job import RunOptions
from ldo_service.runs.offline import run_offline
from ldo_service.runs.source import Selection
from ldo_service.runtime import Actor
from ldo_service.schemas import GraphCorrection, Message, TrackedPose
from tests.runs.false_closures import Drift, DriftingTracker, replaced_actors

NO_LOOPS = "loop_closer.enabled=false"
NONE = Drift(scale=0.0, aside=0.0, turn_rad_per_m=0.0)


@dataclass
class Watched:
    """Actor with its published poses and its CPU time for each correction."""

    actor: Actor
    odometry: list[tuple[float, np.ndarray]] = field(
        default_factory=list
    )  # Time in s and T_odom_camera.
    pauses_ms: list[float] = field(default_factory=list)

    def __post_init__(self) -> None:
        handle = self.actor.handle

        def watching(message: Message) -> Iterator[Message]:
            start_s = time.thread_time()
            made = list(handle(message))
            if isinstance(message, GraphCorrection):
                self.pauses_ms.append(1e3 * (time.thread_time() - start_s))
            self.odometry += [
                (1e-9 * pose.stamp_ns, pose_from_message(pose.T_odom_camera))
                for pose in made
                if isinstance(pose, TrackedPose) and pose.status != "LOST"
            ]
            yield from made

        self.actor.handle = watching


def row(sequence: Sequence, config: Config, drift: Drift, folder: Path) -> str:
    """Run all actors once and return the row of the table."""
    parameters = actor_parameters(config)
    actors = {actor.name: actor for actor in make_actors(parameters)}
    actors["tracker"] = DriftingTracker(parameters.tracker, drift)
    tracker, *others = [Watched(actors[name]) for name in ("tracker", "loop_closer", "mapper")]
    prepare(folder, overwrite=False)
    with replaced_actors(*actors.values()):
        record = run_offline(
            RunOptions(sequence, folder, config, Selection(), print), lambda *_: None
        )
    odometry = Trajectory(*map(np.array, zip(*tracker.odometry, strict=True)))
    run = read_run(folder)
    tracks = (odometry, run.estimates["online"], run.estimates["final"])
    truth = sequence.truth()
    assert truth is not None, f"{sequence.name} has no ground truth"
    ate_cm = [100 * evaluate_trajectory(track, truth).ate_m.rmse for track in tracks]
    held_out = EvaluatedFrames(EvaluatedFrames.of(run.frames).held_out, ())
    rendered = evaluate_rendering(
        sequence, held_out, run.maps, lambda _: None, threads=os.cpu_count() or 1
    )
    pauses = [f"{max(watched.pauses_ms):.0f}" for watched in (tracker, *others)]
    resident = actors["mapper"].metrics()["gaussians"]
    return (
        f"{' | '.join(f'{cm:.2f}' for cm in ate_cm)} | {record.loops.accepted} | "
        f"{rendered[0].mean('psnr_db'):.2f} | {' | '.join(pauses)} | {resident:,.0f} |"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("source", nargs="?", default="synthetic:flat", metavar="SOURCE")
    parser.add_argument("--scale", type=float, default=0.01)
    parser.add_argument("--aside", type=float, default=0.0)
    parser.add_argument("--only", nargs="*", default=(), metavar="RUN")
    parser.add_argument("--turn", type=float, default=0.5, metavar="DEGREES")
    parser.add_argument("--set", nargs="*", default=(), metavar="KEY=VALUE")
    parser.add_argument("--hold-out-every", type=int, default=5)
    options = parser.parse_args()
    sequence = open_sequence(options.source)
    settings = (f"tracker.hold_out={options.hold_out_every}", *options.set)
    drift = Drift(options.scale, options.aside, np.radians(options.turn))
    runs = {
        "no drift": (settings, NONE),
        "drift": (settings, drift),
        "drift, no loops": ((*settings, NO_LOOPS), drift),
    }
    print("| run | odometry cm | online cm | final cm | closures | PSNR dB held out ", end="")
    print("| pause ms tracker | loop closer | mapper | Gaussians |\n|" + "---|" * 10)
    for name, (chosen, drifting) in runs.items():
        if options.only and name not in options.only:
            continue
        with tempfile.TemporaryDirectory() as folder:
            print(f"| {name} | ", end="", flush=True)
            print(row(sequence, load_config(settings=chosen), drifting, Path(folder)), flush=True)


if __name__ == "__main__":
    main()
