"""Programs that show faults of earlier versions with the saved state of a service.

    .venv/bin/python -m tests.faults.state_reproductions
    .venv/bin/python -m tests.faults.state_reproductions half_reset

The programs also run at commit 18f9264, and have verdicts, as those of `service_reproductions`.
"""

import os
import shutil
import signal
import sys
from collections.abc import Callable
from pathlib import Path
from threading import Event, Thread

import zenoh

if not __package__:  # The folder comes last, because the installed package may be the old one.
    sys.path.append(str(Path(__file__).resolve().parents[2]))

from tests.faults.earlier_names import name, run
from tests.faults.reproductions import frames
from tests.faults.serve_process import (
    CHANGED,
    COMMAND,
    LIGHT,
    Camera,
    NotObserved,
    Serve,
    control,
    input_count,
    map_keyframes,
    new_folder,
    starts_with_code_2,
)


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
            # The tracker was reset, so the map has at most the keyframes of the tracker.
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


def used_state() -> bool:
    """A start on a used state folder has exit code 2, as for a typing error."""
    with new_folder() as folder, Serve(folder) as first, first.running(), Serve(folder) as second:
        return starts_with_code_2(second)


PROGRAMS: dict[str, Callable[[], bool]] = {
    program.__name__: program
    for program in (
        half_reset,
        truncated_state,
        unsynced_files,
        second_recording,
        forgotten_pause,
        used_state,
    )
}

if __name__ == "__main__":
    run(PROGRAMS, __file__)
