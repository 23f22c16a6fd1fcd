"""Programs that show faults of earlier versions in a running service; each says SEEN or NOT SEEN.

    .venv/bin/python -m tests.faults.service_reproductions
    .venv/bin/python -m tests.faults.service_reproductions odd_cameras

The programs also run at commit 18f9264, as those of `reproductions` do. A program that reaches
neither the fault nor the healthy result ends with an error, without a verdict.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path
from threading import Thread

import numpy as np
import zenoh

if not __package__:  # The folder comes last, because the installed package may be the old one.
    sys.path.append(str(Path(__file__).resolve().parents[2]))

from ldo_service.client import connect
from tests.faults.earlier_names import name, run
from tests.faults.reproductions import encode, frames, header, image_of
from tests.faults.serve_process import (
    CHANGED,
    LIGHT,
    Camera,
    NotObserved,
    Serve,
    input_count,
    map_keyframes,
    new_folder,
    put,
    starts_with_code_2,
)

STEP_S = 20  # Timeout of a step in the programs with a step that hangs, instead of 60 s.


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


def foreign_samples() -> bool:
    """A sample without a header, or a malformed one, ends the iterator of `Client.messages`."""
    with (
        new_folder() as folder,
        Serve(folder, settings=LIGHT) as serve,
        serve.running() as session,
        Camera(list(frames(20, 3))).streaming(session),
    ):
        errors = [
            error_of_follower(serve, session, body, of_sample)
            for body, of_sample in ((b"", None), (b"\xc1", header(0)))
        ]
    print(f"the iterators ended with {errors}" if any(errors) else "further poses after both")
    return any(errors)


def error_of_follower(
    serve: Serve, session: zenoh.Session, body: bytes, of_sample: bytes | None
) -> str:
    """Send a sample on pose/tracked to a program that follows the poses.

    Returns:
        Name of the error that ends the iterator; empty if further poses follow.
    """
    poses, errors = list[int](), list[str]()

    def follow() -> None:
        try:
            with connect("robot", serve.endpoint) as client:
                for _, pose in client.messages("pose/tracked"):
                    poses.append(pose.stamp_ns)
        except Exception as error:
            errors.append(type(error).__name__)

    Thread(target=follow, daemon=True).start()
    serve.wait("poses", lambda: poses)
    put(session, "pose/tracked", body, of_sample)
    before = len(poses)
    serve.wait("an error, or further poses", lambda: errors or len(poses) >= before + 5)
    return errors[0] if errors else ""


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
    """The tracker makes no keyframe any more after a loss until idle consumers are evicted."""
    settings = (
        f"{name('service.process_actors')}=[tracker,optimizer]",
        # A process that starts again on an overloaded machine would heal the link.
        f"{name('service.heartbeat_timeout_s')}=120",
        # The mapper acknowledges each keyframe, so that it is as idle as the other consumers.
        f"{name('mapper.checkpoint_interval_keyframes')}=1",
        *LIGHT,
    )
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

            serve.wait("all actors are idle", is_idle)
            pids = {actor: health["pid"] for actor, health in serve.health.items()}
            serve.forget_heartbeats()
            serve.wait("heartbeats of idle actors", serve.new_heartbeats)
            before = last = evicted()  # A slow consumer may have been evicted before.
            since = 0

            def is_stable() -> bool:
                """Return whether no further consumer was evicted for 30 frames."""
                nonlocal last, since
                if evicted() > last:
                    last, since = evicted(), frames_tracked()
                return last > before and frames_tracked() >= since + 30

            (folder / "lose").touch()
            with camera.streaming(session):
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
            if pids != {actor: health["pid"] for actor, health in serve.health.items()}:
                raise NotObserved("a process of the service was started again")
            further = serve.metric("tracker", "keyframes") - made
            count = frames_tracked() - first
            print(f"{last - before} evicted, then {further:.0f} keyframes in {count} frames")
            return further == 0


# --- start ----------------------------------------------------------------------------------------
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
        foreign_samples,
        frozen_service,
        lost_keyframes,
        foreign_packages,
        missing_router,
    )
}

if __name__ == "__main__":
    run(PROGRAMS, __file__)
