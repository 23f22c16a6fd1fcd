"""Seeded faults on the real service, and what must hold after each.

    python -m tests.faults.fault_injection OUT.jsonl [--batches 10] [--faults 20] [--seed 0]

A batch is a service on a fresh state folder that meets a number of faults, one after the other,
while a camera goes to and fro. OUT gets a line per fault; batches that are in it whole are skipped,
so a campaign goes on where it was interrupted. Ends with 1 when an invariant was broken.
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
    KEYFRAME_NEW,
    KEYFRAME_REFINEMENT,
    LABEL_RESULT,
    LOOP_CLOSURE,
    MAP_SNAPSHOT,
    OBJECT_OBSERVATION,
)

from .camera import Streaming, frames, number_of, true_poses
from .message_recorder import TAKERS, Witness
from .service_process import (
    ACTORS,
    ALL_APART,
    Life,
    NotRecovered,
    Shown,
    arrays_of,
    difference,
    objects_difference,
    saved_objects,
)

RATE_HZ = 5.0
# What moves objects or graph on after a restart, sent again by who made it; a correction that says
# the same does not.
CHANGING = {
    topic.name for topic in (KEYFRAME_NEW, DETECTION_BOXES, KEYFRAME_REFINEMENT, LOOP_CLOSURE)
}
CHANGING |= {LABEL_RESULT.name, OBJECT_OBSERVATION.name}
BEATS = 6  # of a heart that say the same: 1.5 s, longer than one is on its way
AGAIN_SHARE = 0.3  # of faults: another comes before all have recovered
UNJUDGED_SHARE = 0.3  # of faults: nothing waits for rest or is saved before the next
OFF_MOST_M, OFF_MOST_RAD = 0.05, 0.05  # of a pose in the map: beyond, it was found elsewhere
KEPT = ("tracker", *TAKERS)  # have something to lose

# by placement: kinds, and how often each comes
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
    pose_s: float = 0.0  # from the fault until a pose is OK
    recovered_s: float = 0.0  # and until everybody reports and a new keyframe was made
    keyframes: int = 0
    objects: int = 0
    maps: int = 0  # compared, to the bit
    restarts: int = 0  # whose objects and graph were compared, to the bit
    off_m: float | None = None  # of the last pose, from the truth
    violations: list[str] = field(default_factory=list)


class Batch:
    def __init__(self, number: int, seed: int, folder: Path, scene: list[CameraRgbd]) -> None:
        self.number, self.rng = number, Random(f"{seed}-{number}")
        self.kinds = APART if number % 2 == 0 else TOGETHER
        self.witness = Witness()
        apart = (ALL_APART,) if self.kinds is APART else ()
        synced = (SYNCED,) if number % 4 in (1, 2) else ()  # some of either kind
        self.life = Life(folder, self.witness, (*apart, *synced))
        self.camera = Streaming(scene, RATE_HZ)
        self.truth = true_poses()
        self.objects = 0  # in the map
        self._killed: set[int] = set()  # processes
        self._now()

    def run(self, faults: int, tell: Callable[[Outcome], None]) -> None:
        self.life.start()
        self.camera.start(self.life.client)
        try:
            self._recovered()
            for number in range(faults):
                tell(self._meet(number, is_last=number == faults - 1))
        finally:
            self.camera.stop()
            if self.life.process.poll() is None:
                self.life.kill()

    def _meet(self, number: int, *, is_last: bool) -> Outcome:
        self._killed.clear()
        self.maps = self.restarts = 0
        self.off_m = None
        (kind,) = self.rng.choices(list(self.kinds), list(self.kinds.values()))
        outcome = Outcome(self.number, number, kind)
        time.sleep(self.rng.uniform(0.0, 1.5))
        try:
            self._faults[kind](self, outcome)
            if self.rng.random() < AGAIN_SHARE:
                self._again(outcome)
            outcome.recovered_s = round(self._recovered(), 2)
            outcome.pose_s = round(self._pose_s, 2)
            if self.rng.random() < UNJUDGED_SHARE and not is_last:
                outcome.what += ", not judged"
            else:
                self._judge()
        except NotRecovered as error:
            self.witness.violations.append(f"{error}\n{self.life.tail()}")
            self._begin_again()
        outcome.keyframes, outcome.objects = len(self.witness.made), self.objects
        outcome.maps, outcome.restarts, outcome.off_m = self.maps, self.restarts, self.off_m
        outcome.violations, self.witness.violations = self.witness.violations, []
        return outcome

    def _begin_again(self) -> None:
        """After one that did not recover, so that the next faults say something."""
        self.camera.stop()
        self.life.kill()
        self.life.start()
        self.camera.start(self.life.client)
        with suppress(NotRecovered):
            self._recovered()

    # --- faults -----------------------------------------------------------------------------------
    def _pid(self, actor: str) -> int:
        self.witness.update()
        return self.witness.health[actor][1].pid

    def _kill(self, outcome: Outcome) -> None:
        outcome.what = self.rng.choice(ACTORS)
        self._end(outcome.what, signal.SIGKILL)
        self._now()

    def _kill_optimizer(self, outcome: Outcome) -> None:
        outcome.what = "optimizer"
        self._end("optimizer", signal.SIGKILL)
        self._now()

    def _end(self, actor: str, how: signal.Signals) -> None:
        self._killed.add(self._pid(actor))
        os.kill(self._pid(actor), how)

    def _again(self, outcome: Outcome) -> None:
        """A kill while they recover."""
        time.sleep(self.rng.uniform(0.0, 3.0))
        if self.kinds is APART and self.witness.health:
            actor = self.rng.choice(sorted(self.witness.health))
            with suppress(ProcessLookupError):  # it is gone already
                self._end(actor, signal.SIGKILL)
                outcome.what += f", then {actor}"
            self._now()
        else:
            outcome.what += ", then all"
            self._service(outcome)

    def _stop(self, outcome: Outcome) -> None:
        """A process that lives and does nothing: it is silent, and killed."""
        outcome.what = self.rng.choice(KEPT)
        self._end(outcome.what, signal.SIGSTOP)
        self._now()

    def _hang(self, outcome: Outcome) -> None:
        outcome.what = self.rng.choice(KEPT)
        self._hang_one(outcome.what)

    def _hang_in_main(self, outcome: Outcome) -> None:
        """A stall in the main process ends the service, and systemd starts it again."""
        outcome.what = "mapper"
        old = self._hang_one("mapper")
        while self.life.process.poll() is None and self._pid("mapper") == old:
            time.sleep(0.1)
        self._restart()

    def _hang_one(self, actor: str) -> int:
        old, flag = self._pid(actor), self.life.folder / f"hang-{actor}"
        flag.touch()
        self._killed.add(old)
        self.life.wait(f"{actor} hangs", lambda: not flag.exists())
        self._now()
        return old

    def _full_disk(self, outcome: Outcome) -> None:
        """No file may grow beyond a limit: short ones may, or none. Sometimes a kill comes too."""
        limit = self.rng.choice([0, 20_000])
        actor = self.rng.choice(KEPT)
        pids = {self._pid(actor)} if self.rng.random() < 0.5 else set(map(self._pid, ACTORS))
        is_killed = self.kinds is APART and self.rng.random() < 0.5
        outcome.what = f"{len(pids)} at {limit} bytes" + is_killed * f", {actor} killed"
        self._limit_files(pids, limit)
        time.sleep(self.rng.uniform(1.0, 3.0))
        if is_killed:
            self._end(actor, signal.SIGKILL)
            time.sleep(0.5)
        self._limit_files(pids, resource.RLIM_INFINITY)
        self._now()

    def _limit_files(self, pids: set[int], limit: int) -> None:
        for pid in pids:
            with suppress(ProcessLookupError):
                hard = resource.prlimit(pid, resource.RLIMIT_FSIZE)[1]
                resource.prlimit(pid, resource.RLIMIT_FSIZE, (limit, hard))

    def _bad_disk(self, outcome: Outcome) -> None:
        """Files can be written and often neither renamed, removed nor synced, and folders not be
        made, for a while; perhaps a kill in between, and who comes back meets the same."""
        flag, refusals = (self.life.folder / name for name in ("bad_disk", "refusals"))
        refusals.unlink(missing_ok=True)
        flag.touch()
        self.life.wait("the disk refuses something", refusals.exists)
        time.sleep(self.rng.uniform(1.0, 3.0))
        if self.kinds is APART and self.rng.random() < 0.5:
            self._kill(outcome)
            time.sleep(self.rng.uniform(0.5, 2.0))
        flag.unlink()
        outcome.what += f" {refusals.stat().st_size} refusals"
        self._now()

    def _network(self, outcome: Outcome) -> None:
        """Messages are lost, late and out of order, for a while; perhaps a kill in between."""
        flag = self.life.folder / "bad_network"
        flag.touch()
        time.sleep(self.rng.uniform(2.0, 4.0))
        if self.kinds is APART and self.rng.random() < 0.3:
            self._kill(outcome)
            time.sleep(1.0)
        flag.unlink()
        self._now()

    def _service(self, _outcome: Outcome) -> None:
        self.life.kill()
        self._now()
        self._restart()

    def _restart(self) -> None:
        """Go on from the state on the disk, with the very map that it holds; meanwhile the camera
        moved on."""
        self.camera.stop()
        if self.life.process.poll() is None:
            self.life.kill()
        self.life.close()
        if self.rng.random() < AGAIN_SHARE:  # as it comes back
            self.life.start()
            time.sleep(self.rng.uniform(0.0, 2.0))
            self.life.kill()
        expected = self.life.expected()
        self.camera.skip(self.rng.randrange(8))
        self.life.start()
        if expected is not None:
            self._must_show(expected)
        self.camera.start(self.life.client)

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

    # --- after each -------------------------------------------------------------------------------
    def _now(self) -> None:
        self._met_s = time.monotonic()
        self.witness.update()
        self._stamp_ns = self.camera.stamp_ns
        self._made_before = max(self.witness.made, default=-1)
        self._pose_s = 0.0

    def _recovered(self) -> float:
        """Seconds since the fault: everybody reports, and a keyframe was made since."""
        witness = self.witness
        self.life.wait("a pose is OK", self._is_tracked)
        self._pose_s = time.monotonic() - self._met_s
        self.life.wait("a new keyframe", lambda: max(witness.made, default=-1) > self._made_before)
        self.life.wait("everybody reports", self._all_report)
        return time.monotonic() - self._met_s

    def _is_tracked(self) -> bool:
        """In the map, not in a submap that is not joined to it."""
        pose = self.witness.pose
        return (
            pose is not None
            and pose.stamp_ns >= self._stamp_ns
            and (pose.status, pose.submap) == ("OK", 0)
        )

    def _all_report(self) -> bool:
        heard = self.witness.health
        is_new = [at > self._met_s and h.pid not in self._killed for at, h in heard.values()]
        return len(is_new) == len(ACTORS) and all(is_new)

    def _judge(self) -> None:
        """With the camera still: nothing is lost or doubled, and who comes late has the map."""
        witness, life = self.witness, self.life
        self.camera.stop()
        self._wait_until_still()
        life.wait("all keyframes are handled by all", witness.is_caught_up)
        life.wait("the graph has them all", lambda: set(witness.made) <= witness.placed)
        witness.violations += witness.repeated()
        self._is_where_it_is()
        saved = self._saved_and_told()
        self._same_keyframes("the mapper", saved["map"]["views"]["placed"].tolist())
        self._same_objects(saved)
        self._same_map("a follower", saved, witness.follower)
        self._same_map("who joined late", saved, witness.late)
        witness.join_late(life.client.latest(MAP_SNAPSHOT, 10))
        self.camera.start(life.client)

    def _is_where_it_is(self) -> None:
        """The last pose is in the map, and the true one as far as tracking goes."""
        pose, first_ns = self.witness.pose, self.witness.first_stamp_ns
        if first_ns is None:
            return  # keyframe 0 was not heard: nobody knows what the map's frame is
        if pose is None or pose.status == "LOST" or pose.submap:
            self.witness.violations.append("the last pose is not in the map")
            return
        count = len(self.truth)
        T_true = (
            se3.inverse(self.truth[number_of(first_ns) % count])
            @ self.truth[number_of(pose.stamp_ns) % count]
        )
        T_map_camera = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
        T_off = se3.inverse(T_true) @ T_map_camera
        off_m, off_rad = float(se3.distances(T_off)), se3.rotation_angle(T_off)
        if off_m > OFF_MOST_M or off_rad > OFF_MOST_RAD:
            self.witness.violations.append(f"the pose is {off_m:.2f} m and {off_rad:.2f} rad off")
        self.off_m = round(off_m, 4)

    def _wait_until_still(self) -> None:
        """Until everybody has said, and said again, that nothing waits or is under way."""
        seen: dict[str, int] = {}
        self._now()
        for _ in range(100):
            self.life.wait("everybody reports", self._all_report)
            now = {name: health.steps for name, (_, health) in self.witness.health.items()}
            if now == seen and all(map(_is_idle, self._healths())):
                return
            seen = now
            self._now()
        raise NotRecovered("it does not come to rest")

    def _healths(self) -> list[Health]:
        return [health for _, health in self.witness.health.values()]

    def _saved_and_told(self) -> dict[str, Any]:
        """The mapper's map, on the disk and as followers have been told all that changed."""
        life, before = self.life, self._refined()
        life.client.refine(0, timeout_s=60)
        life.wait("followers are told", lambda: self._refined() > before)
        answer = life.client.control("save")
        if not answer.ok:
            self.witness.violations.append(answer.message)
        saved = life.saved_map()
        version = saved["told"]["version"]
        life.wait(
            "the last delta",
            lambda: self.witness.map_version >= version or self.witness.has_missed_deltas(),
        )
        is_later = self.witness.map_version > version  # a correction came in between
        return self._saved_and_told() if is_later else saved

    def _refined(self) -> int:
        inputs = self.witness.health["mapper"][1].inputs
        return sum(i.delivered for i in inputs if i.topic == "map/refine")

    def _same_map(self, whose: str, saved: dict[str, Any], follower: MapReplica) -> None:
        """One that missed something knows that, and waits for the next snapshot."""
        if follower.is_behind or not follower.version:
            return
        self.maps += 1
        if what := difference(saved["map"]["map"], arrays_of(follower)):
            self.witness.violations.append(f"the map of {whose} has other {what}")

    def _must_show(self, expected: Shown) -> None:
        self.life.wait("the map is shown", lambda: self._is_shown(expected))
        shown = self.life.told()
        assert shown is not None
        self.maps += 1
        if what := difference(arrays_of(expected.map), arrays_of(shown.map)):
            self.witness.violations.append(f"the map after the restart has other {what}")
        graph = expected.graph
        if graph is not None:
            self.life.wait("the graph is told", lambda: self._told_version() >= graph.graph_version)
        taken, told = self._taken_by("mapper", "optimizer"), self.life.told()
        if taken & CHANGING or told is None:
            return  # it has gone on: once all is quiet it is compared with what is saved
        self.restarts += 1
        if expected.objects != told.objects:
            what = objects_difference(expected.objects or (), told.objects or ())
            self.witness.violations.append(f"the map after the restart has other objects: {what}")
        if graph is not None and _as_version_0(told.graph) != _as_version_0(graph):
            self.witness.violations.append("the graph after the restart has other poses")

    def _told_version(self) -> int:
        told = self.life.told()
        return -1 if told is None or told.graph is None else told.graph.graph_version

    def _taken_by(self, *actors: str) -> set[str]:
        """Topics of what they have taken since they began, once they are at rest."""
        heard: list[list[Health]] = []  # heartbeats from now on

        def are_at_rest() -> bool:
            beats = self.witness.health
            now = [beats[actor][1] for actor in actors if actor in beats]
            if len(now) < len(actors):
                return False
            if not heard or all(a is not b for a, b in zip(now, heard[-1], strict=True)):
                heard.append(now)
            last = heard[-BEATS:]
            steps = {tuple(health.steps for health in beat) for beat in last}
            is_idle = all(_is_idle(health) for beat in last for health in beat)
            return len(last) == BEATS and len(steps) == 1 and is_idle

        self.life.wait("they are at rest", are_at_rest)
        return {i.topic for health in heard[-1] for i in health.inputs if i.delivered}

    def _is_shown(self, expected: Shown) -> bool:
        """Objects are told after the map; they may be fewer by now, where boxes came again."""
        shown = self.life.told()
        return shown is not None and (shown.objects is None) <= (expected.objects is None)

    def _same_keyframes(self, whose: str, keyframes: list[int]) -> None:
        if lost := set(self.witness.made) - set(keyframes):
            self.witness.violations.append(f"{whose} lost keyframes {sorted(lost)}")
        if len(set(keyframes)) < len(keyframes):
            self.witness.violations.append(f"{whose} has a keyframe twice")

    def _same_objects(self, saved: dict[str, Any]) -> None:
        told, on_disk = self.life.told(), saved_objects(saved)
        if told is None or (told.objects or ()) != on_disk:
            self.witness.violations.append("other objects are told than saved")
        self.objects = len(on_disk)


def _as_version_0(graph: GraphCorrection | None) -> bytes:
    """All that it says, however often it was said."""
    return b"" if graph is None else encode(msgspec.structs.replace(graph, graph_version=0))


def _is_idle(health: Health) -> bool:
    return health.current_step_s == 0 and not any(count.queued for count in health.inputs)


# --- the campaign ---------------------------------------------------------------------------------
def main() -> int:
    arguments = read_arguments()
    out: Path = arguments.out
    done = whole_batches(out, arguments.faults)
    scene = frames()
    for number in range(arguments.first, arguments.first + arguments.batches):
        if number in done:
            continue
        with tempfile.TemporaryDirectory(prefix="faults-") as folder, out.open("a") as file:

            def tell(outcome: Outcome, file: TextIO = file) -> None:
                print(summary_of(outcome), flush=True)
                file.write(json.dumps(asdict(outcome)) + "\n")
                file.flush()

            Batch(number, arguments.seed, Path(folder), scene).run(arguments.faults, tell)
    outcomes = [Outcome(**json.loads(line)) for line in out.read_text().splitlines()]
    print(table(outcomes))
    return int(any(outcome.violations for outcome in outcomes))


def whole_batches(out: Path, faults: int) -> set[int]:
    """Those that OUT has; what it has of others is dropped."""
    lines = out.read_text().splitlines() if out.exists() else []
    batches = [json.loads(line)["batch"] for line in lines]
    whole = {batch for batch in batches if batches.count(batch) >= faults}
    kept = [f"{line}\n" for line, of in zip(lines, batches, strict=True) if of in whole]
    out.write_text("".join(kept))
    return whole


def read_arguments() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("out", type=Path)
    parser.add_argument("--first", type=int, default=0, help="batch to begin with")
    parser.add_argument("--batches", type=int, default=10)
    parser.add_argument("--faults", type=int, default=20, help="in each batch")
    parser.add_argument("--seed", type=int, default=0)
    return parser.parse_args()


def summary_of(outcome: Outcome) -> str:
    said = "; ".join(outcome.violations) or "held"
    return (
        f"batch {outcome.batch} fault {outcome.number:2d}  {outcome.kind:13s} {outcome.what:28s} "
        f"pose {outcome.pose_s:5.1f} s, all {outcome.recovered_s:5.1f} s, "
        f"{outcome.keyframes} keyframes, {outcome.objects} objects, {outcome.maps} maps, "
        f"{outcome.restarts} restarts, {outcome.off_m} m off  {said}"
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
        f"{len(off_m)} poses at most {100 * max(off_m, default=0):.1f} cm off",
    ]
    return "\n".join(lines)


if __name__ == "__main__":
    sys.exit(main())
