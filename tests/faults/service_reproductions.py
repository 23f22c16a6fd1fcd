"""Programs that show faults of earlier versions in a running service; each says SEEN or NOT SEEN.

    .venv/bin/python -m tests.faults.service_reproductions
    .venv/bin/python -m tests.faults.service_reproductions odd_cameras

The programs also run at commit 18f9264, as those of `reproductions` do. A program that reaches
neither the fault nor the healthy result ends with an error, without a verdict.
"""

import os
import shutil
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread

import numpy as np
import zenoh

if not __package__:  # The folder comes last, because the installed package may be the old one.
    sys.path.append(str(Path(__file__).resolve().parents[2]))

from ldo_service.client import connect
from tests.faults.earlier_names import name, run
from tests.faults.reproductions import encode, frames, header, image_of
from tests.faults.serve_process import (
    Camera,
    NotObserved,
    Serve,
    control,
    map_keyframes,
    new_folder,
    put,
)

COMMAND = (sys.executable, "-m", "ldo_service")
CHANGED = (sys.executable, str(Path(__file__).with_name("changed_serve.py")), "serve")
STEP_S = 20  # Timeout of a step in the programs with a step that hangs, instead of 60 s.
LIGHT = ("mapper.iterations=2", "mapper.threads=1")


def input_count(serve: Serve, actor: str, topic: str, *counters: str) -> int:
    """Return the sum of counters of an input from the last heartbeat of its actor."""
    inputs = serve.health[actor]["inputs"]
    return sum(i[counter] for i in inputs if i["topic"] == topic for counter in counters)


# --- messages -------------------------------------------------------------------------------------
def empty_messages() -> bool:
    """Ten empty messages with sequence numbers 0 and 2^62-1 end the service."""
    with new_folder() as folder, Serve(folder) as serve, serve.running() as session:
        sent_s = time.monotonic()
        for epoch in range(1, 6):
            for seq in (0, 2**62 - 1):
                put(session, "camera/rgbd", b"", header(seq, epoch=epoch))
        serve.forget_heartbeats()
        ended = serve.ends_before("heartbeats after the messages", serve.new_heartbeats)
        if not ended:
            rejected = input_count(serve, "frame_source", "camera/rgbd", "rejected")
            print(f"10 messages, {rejected} rejected, 4 further heartbeats of each actor")
        else:
            took_s = time.monotonic() - sent_s
            print(f"exit code {serve.process.returncode} after {took_s:.1f} s")
        return ended and serve.process.returncode != 0


def odd_cameras() -> bool:
    """Color and depth with odd cameras make a step hang, and the service ends."""
    width, height = 640, 480
    size = {"width": width, "height": height, "cx": width / 2, "cy": height / 2}
    lens = (1e9, 0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 0.0)
    of_color = size | {"fx": 100.0 * width, "fy": 100.0 * height, "distortion": lens}
    of_depth = size | {"fx": 100.0, "fy": 75.0}
    pixels, depth_m = np.zeros((height, width, 3), np.uint8), np.ones((height, width), np.float32)
    both = {"stamp_ns": 10**9, "frame": 0}
    color = both | {"type": "CameraColor", "camera": of_color, "image": image_of("rgb8", pixels)}
    depth = both | {"type": "CameraDepth", "camera": of_depth, "image": image_of("f32", depth_m)}
    settings = (f"{name('supervision.step_timeout_s')}={STEP_S}",)
    with (
        new_folder() as folder,
        Serve(folder, settings=settings) as serve,
        serve.running() as session,
    ):
        sent_s = time.monotonic()
        put(session, "camera/color", encode(color))
        put(session, "camera/depth", encode(depth | {"depth_scale": 1.0}))

        def is_handled() -> bool:
            counts = [
                input_count(serve, "frame_source", topic, "delivered", "rejected")
                for topic in ("camera/color", "camera/depth")
            ]
            return min(counts) > 0 and serve.health["frame_source"]["state"] == "ready"

        ended = serve.ends_before("both messages are handled", is_handled)
        took_s = time.monotonic() - sent_s
        print(
            f"exit code {serve.process.returncode}" if ended else "handled", f"after {took_s:.1f} s"
        )
        return ended and serve.process.returncode == 4


def forged_log_line() -> bool:
    """A name with line breaks in a header writes a line of its own into the log."""
    line = "12:00:00 I ldo_service.control: reset: all actors restarted."
    with new_folder() as folder, Serve(folder) as serve, serve.running() as session:
        put(session, "camera/rgbd", b"\xc1", header(0, f"camera rejected.\n{line}\n12:00:00 I x"))
        serve.wait(
            "the message is rejected",
            lambda: input_count(serve, "frame_source", "camera/rgbd", "rejected"),
        )
        serve.wait("the log has the name", lambda: "reset: all actors restarted." in serve.log)
        forged = sum(text.startswith(line) for text in serve.log.splitlines())
        print(f"{forged} forged lines in the log")
        return forged > 0


def foreign_sample() -> bool:
    """A sample without a header ends the iterator of `Client.messages`."""
    poses, errors = list[int](), list[str]()
    with new_folder() as folder, Serve(folder, settings=LIGHT) as serve, serve.running() as session:

        def follow() -> None:
            try:
                with connect("robot", serve.endpoint) as client:
                    for _, pose in client.messages("pose/tracked"):
                        poses.append(pose.stamp_ns)
            except Exception as error:
                errors.append(repr(error)[:80])

        Thread(target=follow, daemon=True).start()
        with Camera(list(frames(20, 3))).streaming(session):
            serve.wait("a pose", lambda: poses)
            before = len(poses)
            put(session, "pose/tracked", b"")
            put(session, "pose/tracked", b"\xc1", header(0))
            serve.wait("further poses", lambda: errors or len(poses) >= before + 5)
        print(errors[0] if errors else f"{len(poses) - before} further poses")
        return bool(errors)


def frozen_service() -> bool:
    """A service that was frozen (SIGSTOP) for longer than the step timeout ends afterwards."""
    settings = (f"{name('supervision.step_timeout_s')}={STEP_S}", "mapper.threads=1")
    with (
        new_folder() as folder,
        Serve(folder, settings=settings) as serve,
        serve.running() as session,
    ):
        map_keyframes(serve, session, Camera(list(frames(20, 3))), 8)
        serve.wait("the mapper is idle", lambda: serve.health["mapper"]["state"] == "ready")
        rates = {name("initial_rate"): 1.0, name("final_rate"): 1.0}
        body = {"type": name("RefineMap"), "stamp_ns": 1, "iterations": 500, **rates}
        put(session, "map/refine", encode(body), header(0))
        serve.wait("the mapper is busy", lambda: serve.health["mapper"]["state"] == "busy")
        os.kill(serve.process.pid, signal.SIGSTOP)
        time.sleep(STEP_S + 5)
        steps = serve.health["mapper"]["steps"]
        os.kill(serve.process.pid, signal.SIGCONT)
        ended = serve.ends_before("the step ends", lambda: serve.health["mapper"]["steps"] > steps)
        print(
            f"frozen for {STEP_S + 5} s in a step, then "
            + (f"exit code {serve.process.returncode}" if ended else "the step ended")
        )
        return ended and serve.process.returncode == 4


def lost_keyframes() -> bool:
    """After a loss until the eviction of idle consumers, no keyframe is made any more."""
    settings = (f"{name('service.process_actors')}=[tracker,optimizer]", *LIGHT)
    camera, max_frames = Camera(list(frames(30, 3))), 60
    with new_folder() as folder:
        env = {"FAULT_FOLDER": str(folder), "EVICT_AFTER_S": "3"}
        with (
            Serve(folder, settings=settings, command=CHANGED, env=env) as serve,
            serve.running() as session,
        ):
            map_keyframes(serve, session, camera, 4)
            camera.period_s = 0.5  # The consumers handle each keyframe before the next one comes.

            def frames_tracked() -> int:
                return input_count(serve, "tracker", "frame/rgbd", "delivered")

            def evicted() -> int:
                outputs = {o["topic"]: o for o in serve.health["tracker"]["outputs"]}
                return outputs["keyframe/new"][name("evicted_consumers")]

            def is_idle() -> bool:
                return all(health["state"] == "ready" for health in serve.health.values())

            last = since = 0

            def is_stable() -> bool:
                """Return whether no further consumer was evicted for 30 frames."""
                nonlocal last, since
                if evicted() > last:
                    last, since = evicted(), frames_tracked()
                return last > 0 and frames_tracked() >= since + 30

            serve.wait("all actors are idle", is_idle)
            with camera.streaming(session):
                (folder / "lose").touch()
                serve.wait("all consumers that can be evicted are evicted", is_stable)
                (folder / "lose").unlink()
                first = frames_tracked() + 10  # The link may take some frames to continue.
                serve.wait("frames after the loss", lambda: frames_tracked() >= first)
                made = serve.metric("tracker", "keyframes")
                serve.wait(
                    "keyframes after the loss, or many frames without",
                    lambda: (
                        serve.metric("tracker", "keyframes") >= made + 3
                        or frames_tracked() >= first + max_frames
                    ),
                )
            further = serve.metric("tracker", "keyframes") - made
            after = frames_tracked() - first
            print(f"{last} evicted; {further:.0f} keyframes in {after} frames after the loss")
            return further == 0


# --- state ----------------------------------------------------------------------------------------
def half_reset() -> bool:
    """A kill between the resets of two actors leaves states of different runs, without an error."""
    settings = (f"{name('mapper.checkpoint_interval_keyframes')}=1", *LIGHT)
    scene = list(frames(30, 3))
    with new_folder() as folder:
        with Serve(folder, settings=settings) as serve:
            with serve.running() as session:
                map_keyframes(serve, session, Camera(scene), 10)
            serve.stop()
        shutil.copytree(folder / "state", folder / "backup")
        for attempt in range(10):
            shutil.rmtree(folder / "state")
            shutil.copytree(folder / "backup", folder / "state")
            with Serve(folder, settings=settings) as serve, serve.running() as session:
                is_half = kill_in_reset(serve, session, may_be_missing=attempt >= 6)
            if is_half:
                break
        else:
            raise NotObserved("no kill came between the resets of tracker and mapper")
        with Serve(folder, settings=settings) as serve, serve.running() as session:
            with Camera(scene).streaming(session):
                serve.wait(
                    "new keyframes in the map",
                    lambda: (
                        serve.metric("tracker", "keyframes") >= 6
                        and input_count(serve, "mapper", "keyframe/new", "delivered") >= 6
                    ),
                )
            serve.forget_heartbeats()
            serve.wait("heartbeats", serve.new_heartbeats)
            repeated, keyframes = (
                serve.metric("mapper", of_mapper)
                for of_mapper in ("keyframes_repeated", "keyframes")
            )
            made = serve.metric("tracker", "keyframes")
            print(
                f"{made:.0f} keyframes since the reset, {keyframes:.0f} in the map, "
                f"{repeated:.0f} dropped as repeated"
            )
            # The tracker begins anew, so the map has at most the keyframes of the tracker.
            return repeated > 0 or keyframes > made


def kill_in_reset(serve: Serve, session: zenoh.Session, *, may_be_missing: bool) -> bool:
    """Kill a service during a reset, as soon as the tracker has an empty state on the disk.

    Args:
        serve: The service.
        session: A session.
        may_be_missing: Whether a tracker without a state counts as one with an empty state.

    Returns:
        Whether the tracker was reset, and the mapper was not.
    """
    folder, answered = serve.state / "state", Event()
    sizes = {
        actor: (folder / actor / "contents.msgpack").stat().st_size
        for actor in ("tracker", "mapper")
    }

    def is_reset(actor: str) -> bool:
        try:
            size = (folder / actor / "contents.msgpack").stat().st_size
        except FileNotFoundError:
            return may_be_missing
        return size < 0.9 * sizes[actor]

    def kill() -> None:
        while not is_reset("tracker") and not answered.is_set():
            pass
        os.kill(serve.process.pid, signal.SIGKILL)

    killer = Thread(target=kill)
    killer.start()
    control(session, "reset", 20.0)
    answered.set()
    killer.join()
    serve.kill()
    return is_reset("tracker") and not is_reset("mapper")


def truncated_state() -> bool:
    """A truncated part of a saved state ends every start of the service."""
    with new_folder() as folder:
        with Serve(folder, settings=LIGHT) as serve:
            with serve.running() as session:
                map_keyframes(serve, session, Camera(list(frames(20, 3))), 4)
            serve.stop()
        part = max(
            (folder / "state/state/tracker").glob("now.*"), key=lambda p: p.stat().st_mtime_ns
        )
        body = part.read_bytes()
        part.unlink()  # The file may have other names, in older generations.
        part.write_bytes(body[:-20])
        codes = list[int | None]()
        for _ in range(2):
            with Serve(folder, settings=LIGHT) as serve:
                try:
                    with serve.running():
                        serve.wait("a map", lambda: serve.metric("mapper", "keyframes") >= 3)
                        codes.append(None)
                        break
                except NotObserved:
                    codes.append(serve.exit_code(5.0))
        print(f"exit codes {codes}" if codes[0] else "the service starts with its map")
        return codes == [2, 2]


def unsynced_files() -> bool:
    """Files to which a synced state refers are not synced, although the setting promises it."""
    settings = (
        f"{name('service.fsync')}=true",
        f"{name('mapper.offload.max_resident_gaussians')}=500",
        *LIGHT,
    )
    with new_folder() as folder:
        env = {"FAULT_FOLDER": str(folder)}
        with (
            Serve(folder, settings=settings, command=CHANGED, env=env) as serve,
            serve.running() as session,
        ):
            map_keyframes(serve, session, Camera(list(frames(30, 3))), 12)
            serve.wait("the mapper is idle", lambda: serve.health["mapper"]["state"] == "ready")
            is_saved, text = control(session, "save")
            synced = set((folder / "synced").read_text().splitlines())
            files = {str(path) for path in (serve.state / "map").rglob("*") if path.is_file()}
            of_state = {path for path in synced if path.startswith(str(serve.state / "state"))}
            if not (is_saved and files and of_state):
                raise NotObserved(f"{len(files)} files, {len(of_state)} synced; {text}")
        print(f"{len(files - synced)} of {len(files)} files of the map are not synced")
        return bool(files - synced)


def second_recording() -> bool:
    """`ldo record` cannot be started again on the folder of its recording."""
    with new_folder() as folder:
        command = (*COMMAND, "record", str(folder / "recording"))
        with Serve(folder, command=command) as serve, serve.running():
            serve.kill()
        with Serve(folder, command=command) as serve:
            return starts_with_code_2(serve)


# --- start ----------------------------------------------------------------------------------------
def starts_with_code_2(serve: Serve) -> bool:
    """Return whether a start ends with exit code 2, as for a typing error."""
    try:
        with serve.running():
            print("all actors run")
            return False
    except NotObserved:
        code = serve.exit_code(5.0)
        print(f"exit code {code}")
        return code == 2


def forgotten_pause() -> bool:
    """A paused service is no longer paused after a restart."""
    with new_folder() as folder:
        paused = list[bool]()
        for is_first in (True, False):
            with Serve(folder) as serve, serve.running() as session:
                if is_first:
                    control(session, "pause")
                serve.forget_heartbeats()
                serve.wait("heartbeats", serve.new_heartbeats)
                paused.append(serve.health["frame_source"].get(name("paused"), False))
                serve.stop()
        if not paused[0]:
            raise NotObserved("the service is not paused by the command")
        print(f"paused before the restart: {paused[0]}, after it: {paused[1]}")
        return not paused[1]


def foreign_packages() -> bool:
    """Child processes run packages in the folder in which the service was started."""
    with new_folder() as folder:
        mark = f"open({str(folder / 'ran')!r}, 'w').close()\n"
        # The second name serves for an editable installation, which comes before the folder.
        for package in ("ldo_service", "msgspec"):
            (folder / package).mkdir()
            for file in ("__init__.py", "__main__.py"):
                (folder / package / file).write_text(mark)
        ldo, ran = str(Path(sys.executable).with_name("ldo")), folder / "ran"
        with Serve(folder, command=(ldo, "serve")) as serve:
            try:
                with serve.running():
                    print("all actors run")
            except NotObserved:
                if not ran.exists():
                    raise
                print(f"a foreign package ran, exit code {serve.process.poll()}")
        return ran.exists()


def used_state() -> bool:
    """A start on a used state folder has exit code 2, as for a typing error."""
    with new_folder() as folder, Serve(folder) as first, first.running(), Serve(folder) as second:
        return starts_with_code_2(second)


def missing_router() -> bool:
    """A start as the client of a missing router has exit code 2, as for a typing error."""
    with new_folder() as folder, Serve(folder, name("--client")) as serve:
        return starts_with_code_2(serve)


PROGRAMS: dict[str, Callable[[], bool]] = {
    program.__name__: program
    for program in (
        empty_messages,
        odd_cameras,
        forged_log_line,
        foreign_sample,
        frozen_service,
        lost_keyframes,
        half_reset,
        truncated_state,
        unsynced_files,
        second_recording,
        forgotten_pause,
        foreign_packages,
        used_state,
        missing_router,
    )
}

if __name__ == "__main__":
    run(PROGRAMS, __file__)
