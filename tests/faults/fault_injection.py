"""Seeded faults on the real service, and invariants that hold after each.

    python -m tests.faults.fault_injection OUT.jsonl [--batches 10] [--faults 20] [--seed 0]
    python -m tests.faults.fault_injection OUT.jsonl --defaults

With `--defaults`, the service has TLS keys, default settings and frames of 320x240. If it ends
because its restart budget is used up, it is started again after 5 s, as systemd does.

A batch runs a service on a fresh state folder while a camera moves to and fro. It injects a number
of faults one after the other. OUT gets a line per fault. Complete batches in OUT are skipped, so an
interrupted campaign resumes. The exit code is 1 if an invariant was violated.
"""

import argparse
import json
import os
import resource
import signal
import sys
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from random import Random
from typing import Any, TextIO

import msgspec
import numpy as np

from ldo_service.conversions.poses import pose_from_message
from ldo_service.geometry import se3
from ldo_service.maps.replica import MapReplica
from ldo_service.schemas import CameraRgbd, GraphCorrection, Health, encode
from ldo_service.schemas.topics import (
    DETECTION_BOXES,
    KEYFRAME_MEASUREMENTS,
    KEYFRAME_NEW,
    KEYFRAME_REFINEMENT,
    LABEL_RESULT,
    LOOP_CLOSURE,
    MAP_SNAPSHOT,
    OBJECT_OBSERVATION,
)

from .camera import CameraStream, frames, number_of, true_poses
from .message_recorder import CONSUMERS, MessageRecorder
from .service_process import (
    ACTORS,
    ALL_APART,
    NotRecovered,
    PublishedState,
    ServiceProcess,
    arrays_of,
    difference,
    objects_difference,
    saved_objects,
)

RATE_HZ = 5.0
# Topics that change objects or the pose graph when their producers send them again after a restart.
# A repeated correction changes neither.
CHANGING = {
    topic.name for topic in (KEYFRAME_NEW, DETECTION_BOXES, KEYFRAME_REFINEMENT, LOOP_CLOSURE)
}
CHANGING |= {LABEL_RESULT.name, OBJECT_OBSERVATION.name, KEYFRAME_MEASUREMENTS.name}
IDLE_HEARTBEATS = 6  # Equal heartbeats of an idle actor: 1.5 s, longer than a heartbeat takes.
SECOND_FAULT_RATIO = 0.3  # Fraction of faults with a second one before all have recovered.
UNCHECKED_RATIO = 0.3  # Fraction of faults after which the service is neither idle nor saved.
MAX_ERROR_M, MAX_ERROR_RAD = 0.05, 0.05  # Maximum pose error; a larger one is a wrong place.
STATEFUL = ("tracker", *CONSUMERS)  # Actors with a state to lose.

# Kinds of faults and their weights, by placement of the actors.
DISK_AND_NETWORK = {"full disk": 3, "bad disk": 3, "network": 3}
APART = {"kill": 10, "stop": 1, "hang": 2, "service": 1, **DISK_AND_NETWORK}
TOGETHER = {"service": 10, "optimizer": 2, "hang in main": 1, **DISK_AND_NETWORK}
SYNCED = "service.fsync=true"


@dataclass
class Outcome:
    batch: int
    number: int
    kind: str
    what: str = ""
    pose_s: float = 0.0  # Time from the fault until a pose is OK.
    recovered_s: float = 0.0  # Time until all actors report and a new keyframe exists.
    keyframes: int = 0
    objects: int = 0
    maps: int = 0  # Number of maps that were compared bit by bit.
    restarts: int = 0  # Number of restarts after which objects and graph were compared bit by bit.
    off_m: float | None = None  # Position error of the last pose.
    ends: int = 0  # Number of times that the restart budget was used up.
    violations: list[str] = field(default_factory=list)


class Batch:
    def __init__(
        self,
        number: int,
        seed: int,
        folder: Path,
        scene: list[CameraRgbd],
        *,
        has_defaults: bool = False,
    ) -> None:
        self.number, self.rng = number, Random(f"{seed}-{number}")
        self.kinds = APART if number % 2 == 0 else TOGETHER
        self.recorder = MessageRecorder()
        apart = (ALL_APART,) if self.kinds is APART else ()
        synced = (SYNCED,) if number % 4 in (1, 2) else ()  # Some batches of each placement.
        self.service = ServiceProcess(
            folder, self.recorder, (*apart, *synced), has_defaults=has_defaults
        )
        self.service.on_end = self._start_again
        # By default, a step of any other actor may take ten minutes, also in a stopped process.
        self.hanging = ("tracker", "mapper") if has_defaults else STATEFUL
        self.camera = CameraStream(scene, RATE_HZ)
        self.truth = true_poses()
        self.objects = 0  # Number of objects in the map.
        self._killed: set[int] = set()  # Process ids.
        self._mark_fault()

    def run(self, faults: int, report: Callable[[Outcome], None]) -> None:
        self.service.start()
        self.camera.start(self.service.client)
        try:
            self._wait_for_recovery()
            for number in range(faults):
                report(self._inject_fault(number, is_last=number == faults - 1))
        finally:
            self.camera.stop()
            if self.service.process.poll() is None:
                self.service.kill()

    def _inject_fault(self, number: int, *, is_last: bool) -> Outcome:
        self._killed.clear()
        self.maps = self.restarts = self.service.ends = 0
        self.off_m = None
        (kind,) = self.rng.choices(list(self.kinds), list(self.kinds.values()))
        outcome = Outcome(self.number, number, kind)
        time.sleep(self.rng.uniform(0.0, 1.5))
        try:
            self._faults[kind](self, outcome)
            if self.rng.random() < SECOND_FAULT_RATIO:
                self._second_fault(outcome)
            outcome.recovered_s = round(self._wait_for_recovery(), 2)
            outcome.pose_s = round(self._pose_s, 2)
            if self.rng.random() < UNCHECKED_RATIO and not is_last:
                outcome.what += ", not checked"
            else:
                self._check_invariants()
        except NotRecovered as error:
            self.recorder.violations.append(f"{error}\n{self.service.tail()}")
            self._restart_after_failure()
        outcome.keyframes, outcome.objects = len(self.recorder.keyframes), self.objects
        outcome.maps, outcome.restarts, outcome.off_m = self.maps, self.restarts, self.off_m
        outcome.ends = self.service.ends
        outcome.violations, self.recorder.violations = self.recorder.violations, []
        return outcome

    def _restart_after_failure(self) -> None:
        """Kill and start a service that did not recover, so that the next faults are meaningful."""
        self.camera.stop()
        self.service.kill()
        self.service.start()
        self.camera.start(self.service.client)
        with suppress(NotRecovered):
            self._wait_for_recovery()

    def _start_again(self) -> None:
        self.camera.stop()
        self.service.close()
        self.service.start()
        self.camera.start(self.service.client)

    # --- faults -----------------------------------------------------------------------------------
    def _pid(self, actor: str) -> int:
        self.recorder.update()
        return self.recorder.health[actor][1].pid

    def _kill(self, outcome: Outcome) -> None:
        outcome.what = self.rng.choice(ACTORS)
        self._end(outcome.what, signal.SIGKILL)
        self._mark_fault()

    def _kill_optimizer(self, outcome: Outcome) -> None:
        outcome.what = "optimizer"
        self._end("optimizer", signal.SIGKILL)
        self._mark_fault()

    def _end(self, actor: str, how: signal.Signals) -> None:
        self._killed.add(self._pid(actor))
        os.kill(self._pid(actor), how)

    def _second_fault(self, outcome: Outcome) -> None:
        """Kill an actor or the service during the recovery."""
        time.sleep(self.rng.uniform(0.0, 3.0))
        if self.kinds is APART and self.recorder.health:
            actor = self.rng.choice(sorted(self.recorder.health))
            with suppress(ProcessLookupError):  # The process may have ended.
                self._end(actor, signal.SIGKILL)
                outcome.what += f", then {actor}"
            self._mark_fault()
        else:
            outcome.what += ", then all"
            self._service(outcome)

    def _stop(self, outcome: Outcome) -> None:
        """Stop a process with SIGSTOP; the supervisor kills it because it is silent."""
        outcome.what = self.rng.choice(self.hanging)
        self._end(outcome.what, signal.SIGSTOP)
        self._mark_fault()

    def _hang(self, outcome: Outcome) -> None:
        outcome.what = self.rng.choice(self.hanging)
        self._hang_one(outcome.what)

    def _hang_in_main(self, outcome: Outcome) -> None:
        """Make the mapper hang in the main process, then restart the service as systemd does."""
        outcome.what = "mapper"
        old = self._hang_one("mapper")
        while self.service.process.poll() is None and self._pid("mapper") == old:
            time.sleep(0.1)
        self._restart()

    def _hang_one(self, actor: str) -> int:
        old, flag = self._pid(actor), self.service.folder / f"hang-{actor}"
        flag.touch()
        self._killed.add(old)
        self.service.wait(f"{actor} hangs", lambda: not flag.exists())
        self._mark_fault()
        return old

    def _full_disk(self, outcome: Outcome) -> None:
        """Limit the size of files to 0 or 20 kB for a while, sometimes with a kill."""
        limit = self.rng.choice([0, 20_000])
        actor = self.rng.choice(STATEFUL)
        pids = {self._pid(actor)} if self.rng.random() < 0.5 else set(map(self._pid, ACTORS))
        is_killed = self.kinds is APART and self.rng.random() < 0.5
        outcome.what = f"{len(pids)} at {limit} bytes" + is_killed * f", {actor} killed"
        self._limit_files(pids, limit)
        time.sleep(self.rng.uniform(1.0, 3.0))
        if is_killed:
            self._end(actor, signal.SIGKILL)
            time.sleep(0.5)
        self._limit_files(pids, resource.RLIM_INFINITY)
        self._mark_fault()

    def _limit_files(self, pids: set[int], limit: int) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, hard))

    def _bad_disk(self, outcome: Outcome) -> None:
        """Make renames, removals, syncs and new folders fail often for a while.

        Sometimes an actor is killed in between and restarts on the same disk.
        """
        flag, refusals = (self.service.folder / name for name in ("bad_disk", "refusals"))
        refusals.unlink(missing_ok=True)
        flag.touch()
        self.service.wait("the disk refuses something", refusals.exists)
        time.sleep(self.rng.uniform(1.0, 3.0))
        if self.kinds is APART and self.rng.random() < 0.5:
            self._kill(outcome)
            time.sleep(self.rng.uniform(0.5, 2.0))
        flag.unlink()
        outcome.what += f" {refusals.stat().st_size} refusals"
        self._mark_fault()

    def _network(self, outcome: Outcome) -> None:
        """Lose, delay and reorder messages for a while, sometimes with a kill."""
        flag = self.service.folder / "bad_network"
        flag.touch()
        time.sleep(self.rng.uniform(2.0, 4.0))
        if self.kinds is APART and self.rng.random() < 0.3:
            self._kill(outcome)
            time.sleep(1.0)
        flag.unlink()
        self._mark_fault()

    def _service(self, _outcome: Outcome) -> None:
        self.service.kill()
        self._mark_fault()
        self._restart()

    def _restart(self) -> None:
        """Restart from the state on the disk and check its map; the camera moved on meanwhile."""
        self.camera.stop()
        if self.service.process.poll() is None:
            self.service.kill()
        self.service.close()
        if self.rng.random() < SECOND_FAULT_RATIO:  # A second kill during the restart.
            self.service.start()
            time.sleep(self.rng.uniform(0.0, 2.0))
            self.service.kill()
        expected = self.service.expected()
        self.camera.skip(self.rng.randrange(8))
        self.service.start()
        if expected is not None:
            self._check_restart(expected)
        self.camera.start(self.service.client)

    _faults = {
        "kill": _kill,
        "optimizer": _kill_optimizer,
        "stop": _stop,
        "hang": _hang,
        "hang in main": _hang_in_main,
        "full disk": _full_disk,
        "bad disk": _bad_disk,
        "network": _network,
        "service": _service,
    }

    # --- invariants -------------------------------------------------------------------------------
    def _mark_fault(self) -> None:
        self._fault_s = time.monotonic()
        self.recorder.update()
        self._stamp_ns = self.camera.stamp_ns
        self._keyframe_before = max(self.recorder.keyframes, default=-1)
        self._pose_s = 0.0

    def _wait_for_recovery(self) -> float:
        """Wait until all actors report and a keyframe was made; return seconds since the fault."""
        recorder = self.recorder
        self.service.wait("a pose is OK", self._is_tracked)
        self._pose_s = time.monotonic() - self._fault_s
        self.service.wait(
            "a new keyframe", lambda: max(recorder.keyframes, default=-1) > self._keyframe_before
        )
        self.service.wait("all actors report", self._all_report)
        return time.monotonic() - self._fault_s

    def _is_tracked(self) -> bool:
        """Return whether a pose since the fault is OK and in the main map, not in a submap."""
        pose = self.recorder.pose
        return (
            pose is not None
            and pose.stamp_ns >= self._stamp_ns
            and (pose.status, pose.submap) == ("OK", 0)
        )

    def _all_report(self) -> bool:
        heartbeats = self.recorder.health
        is_new = [at > self._fault_s and h.pid not in self._killed for at, h in heartbeats.values()]
        return len(is_new) == len(ACTORS) and all(is_new)

    def _check_invariants(self) -> None:
        """Stop the camera and check that no data is lost or doubled and all replicas are equal."""
        recorder, service = self.recorder, self.service
        self.camera.stop()
        self._wait_until_still()
        service.wait("all keyframes are handled by all", recorder.is_caught_up)
        service.wait("the graph has them all", lambda: set(recorder.keyframes) <= recorder.placed)
        recorder.violations += recorder.repeated()
        self._check_pose()
        saved = self._saved_and_published()
        self._check_keyframes("the mapper", saved["map"]["views"]["placed"].tolist())
        self._check_objects(saved)
        self._check_map("the replica", saved, recorder.replica)
        self._check_map("the late replica", saved, recorder.late_replica)
        recorder.join_late(service.client.latest(MAP_SNAPSHOT, 10))
        self.camera.start(service.client)

    def _check_pose(self) -> None:
        """Check that the last pose is in the map and near the true pose."""
        pose, first_ns = self.recorder.pose, self.recorder.first_stamp_ns
        if first_ns is None:
            return  # Keyframe 0 was not received, so the frame of the map is unknown.
        if pose is None or pose.status == "LOST" or pose.submap:
            self.recorder.violations.append("the last pose is not in the map")
            return
        count = len(self.truth)
        T_true = (
            se3.inverse(self.truth[number_of(first_ns) % count])
            @ self.truth[number_of(pose.stamp_ns) % count]
        )
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        T_off = se3.inverse(T_true) @ T_map_camera
        off_m, off_rad = float(se3.distances(T_off)), se3.rotation_angle(T_off)
        if off_m > MAX_ERROR_M or off_rad > MAX_ERROR_RAD:
            self.recorder.violations.append(f"the pose is {off_m:.2f} m and {off_rad:.2f} rad off")
        self.off_m = round(off_m, 4)

    def _wait_until_still(self) -> None:
        """Wait until two heartbeats of each actor report no queued message and no step."""
        seen: dict[str, int] = {}
        self._mark_fault()
        for _ in range(100):
            self.service.wait("all actors report", self._all_report)
            now = {name: health.steps for name, (_, health) in self.recorder.health.items()}
            if now == seen and all(map(_is_idle, self._healths())):
                return
            seen = now
            self._mark_fault()
        raise NotRecovered("the service does not become idle")

    def _healths(self) -> list[Health]:
        return [health for _, health in self.recorder.health.values()]

    def _saved_and_published(self) -> dict[str, Any]:
        """Make the mapper publish all changes and save its map; return the saved state."""
        service, before = self.service, self._refined()
        service.client.refine(0, timeout_s=60)
        service.wait("the changes are published", lambda: self._refined() > before)
        answer = service.client.control("save")
        if not answer.ok:
            self.recorder.violations.append(answer.message)
        saved = service.saved_map()
        version = saved["publisher"]["version"]
        service.wait(
            "the last delta",
            lambda: self.recorder.map_version >= version or self.recorder.has_missed_deltas(),
        )
        is_later = self.recorder.map_version > version  # A correction arrived in between.
        return self._saved_and_published() if is_later else saved

    def _refined(self) -> int:
        inputs = self.recorder.health["mapper"][1].inputs
        return sum(i.delivered for i in inputs if i.topic == "map/refine")

    def _check_map(self, owner: str, saved: dict[str, Any], replica: MapReplica) -> None:
        """Compare a replica with the saved map, unless it waits for the next snapshot."""
        if replica.is_behind or not replica.version:
            return
        self.maps += 1
        if what := difference(saved["map"]["map"], arrays_of(replica)):
            self.recorder.violations.append(f"the map of {owner} has other {what}")

    def _check_restart(self, expected: PublishedState) -> None:
        self.service.wait("the map is published", lambda: self._is_published(expected))
        shown = self.service.published()
        assert shown is not None
        self.maps += 1
        if what := difference(arrays_of(expected.map), arrays_of(shown.map)):
            self.recorder.violations.append(f"the map after the restart has other {what}")
        graph = expected.graph
        if graph is not None:
            self.service.wait(
                "the graph is published", lambda: self._published_version() >= graph.graph_version
            )
        taken, published = self._received_topics("mapper", "optimizer"), self.service.published()
        if taken & CHANGING or published is None:
            return  # The state has changed; `_check_invariants` compares it later.
        self.restarts += 1
        if expected.objects != published.objects:
            what = objects_difference(expected.objects or (), published.objects or ())
            self.recorder.violations.append(f"the map after the restart has other objects: {what}")
        if graph is not None and _as_version_0(published.graph) != _as_version_0(graph):
            self.recorder.violations.append("the graph after the restart has other poses")

    def _published_version(self) -> int:
        published = self.service.published()
        return -1 if published is None or published.graph is None else published.graph.graph_version

    def _received_topics(self, *actors: str) -> set[str]:
        """Wait until actors are idle and return the topics they received since their start."""
        heartbeats: list[list[Health]] = []  # Heartbeats from now on.

        def are_idle() -> bool:
            beats = self.recorder.health
            now = [beats[actor][1] for actor in actors if actor in beats]
            if len(now) < len(actors):
                return False
            if not heartbeats or all(a is not b for a, b in zip(now, heartbeats[-1], strict=True)):
                heartbeats.append(now)
            last = heartbeats[-IDLE_HEARTBEATS:]
            steps = {tuple(health.steps for health in beat) for beat in last}
            is_idle = all(_is_idle(health) for beat in last for health in beat)
            return len(last) == IDLE_HEARTBEATS and len(steps) == 1 and is_idle

        self.service.wait("the actors are idle", are_idle)
        return {i.topic for health in heartbeats[-1] for i in health.inputs if i.delivered}

    def _is_published(self, expected: PublishedState) -> bool:
        """Return whether the map is published, and the objects if there are any.

        Objects are published after the map. Repeated detections may have reduced their number.
        """
        shown = self.service.published()
        return shown is not None and (shown.objects is None) <= (expected.objects is None)

    def _check_keyframes(self, owner: str, keyframes: list[int]) -> None:
        if lost := set(self.recorder.keyframes) - set(keyframes):
            self.recorder.violations.append(f"{owner} lost keyframes {sorted(lost)}")
        if len(set(keyframes)) < len(keyframes):
            self.recorder.violations.append(f"{owner} has a keyframe twice")

    def _check_objects(self, saved: dict[str, Any]) -> None:
        published, on_disk = self.service.published(), saved_objects(saved)
        if published is None or (published.objects or ()) != on_disk:
            self.recorder.violations.append("the published objects differ from the saved ones")
        self.objects = len(on_disk)


def _as_version_0(graph: GraphCorrection | None) -> bytes:
    """Return the encoded correction without its version."""
    return b"" if graph is None else encode(msgspec.structs.replace(graph, graph_version=0))


def _is_idle(health: Health) -> bool:
    return health.current_step_s == 0 and not any(count.queued for count in health.inputs)


# --- the campaign ---------------------------------------------------------------------------------
def main() -> int:
    arguments = read_arguments()
    out: Path = arguments.out
    done = whole_batches(out, arguments.faults)
    scene = frames(is_small=not arguments.defaults)
    for number in range(arguments.first, arguments.first + arguments.batches):
        if number in done:
            continue
        with tempfile.TemporaryDirectory(prefix="faults-") as folder, out.open("a") as file:

            def report(outcome: Outcome, file: TextIO = file) -> None:
                print(summary_of(outcome), flush=True)
                file.write(json.dumps(asdict(outcome)) + "\n")
                file.flush()

            batch = Batch(
                number, arguments.seed, Path(folder), scene, has_defaults=arguments.defaults
            )
            batch.run(arguments.faults, report)
    outcomes = [Outcome(**json.loads(line)) for line in out.read_text().splitlines()]
    print(table(outcomes))
    return int(any(outcome.violations for outcome in outcomes))


def whole_batches(out: Path, faults: int) -> set[int]:
    """Return the complete batches in OUT and remove the lines of all others."""
    lines = out.read_text().splitlines() if out.exists() else []
    batches = [json.loads(line)["batch"] for line in lines]
    whole = {batch for batch in batches if batches.count(batch) >= faults}
    kept = [f"{line}\n" for line, of in zip(lines, batches, strict=True) if of in whole]
    out.write_text("".join(kept))
    return whole


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0, help="number of the first batch")
    parser.add_argument("--batches", type=int, default=10)
    parser.add_argument("--faults", type=int, default=20, help="number of faults per batch")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--defaults", action="store_true", help="TLS keys, default settings, frames of 320x240"
    )
    return parser.parse_args()


def summary_of(outcome: Outcome) -> str:
    result = "; ".join(outcome.violations) or "held"
    return (
        f"batch {outcome.batch} fault {outcome.number:2d}  {outcome.kind:13s} {outcome.what:28s} "
        f"pose {outcome.pose_s:5.1f} s, all {outcome.recovered_s:5.1f} s, "
        f"{outcome.keyframes} keyframes, {outcome.objects} objects, {outcome.maps} maps, "
        f"{outcome.restarts} restarts, {outcome.off_m} m off  {result}"
    )


def table(outcomes: list[Outcome]) -> str:
    lines = ["| fault | times | pose again p50 / p95 s | all again p50 / p95 s | broken |"]
    lines.append("|---|---|---|---|---|")
    for kind in (*sorted({o.kind for o in outcomes}), "all"):
        of = [o for o in outcomes if kind in (o.kind, "all")]
        pose = np.percentile([o.pose_s for o in of], (50, 95))
        whole = np.percentile([o.recovered_s for o in of], (50, 95))
        broken = sum(bool(o.violations) for o in of)
        lines.append(
            f"| {kind} | {len(of)} | {pose[0]:.1f} / {pose[1]:.1f} | "
            f"{whole[0]:.1f} / {whole[1]:.1f} | {broken} |"
        )
    maps, restarts = (sum(getattr(o, name) for o in outcomes) for name in ("maps", "restarts"))
    off_m = [o.off_m for o in outcomes if o.off_m is not None]
    lines += [
        "",
        f"compared to the bit: {maps} maps, objects and graph after {restarts} restarts; "
        f"{len(off_m)} poses at most {100 * max(off_m, default=0):.1f} cm off; restart budget used "
        f"up {sum(o.ends for o in outcomes)} times",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
