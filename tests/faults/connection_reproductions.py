"""Programs that show faults of earlier versions with connections, readers and TLS keys.

    .venv/bin/python -m tests.faults.connection_reproductions
    .venv/bin/python -m tests.faults.connection_reproductions map_readers

The programs also run at commit 18f9264, and have verdicts, as those of `service_reproductions`.
"""

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from threading import Event, Thread

if not __package__:  # The folder comes last, because the installed package may be the old one.
    sys.path.append(str(Path(__file__).resolve().parents[2]))

from tests.faults.earlier_names import found, name, run
from tests.faults.reproductions import frames, header
from tests.faults.serve_process import (
    LIGHT,
    Camera,
    NotObserved,
    Serve,
    children_of,
    control,
    map_keyframes,
    new_folder,
    put,
)
from tests.ports import free_port

READERS = (sys.executable, str(Path(__file__).with_name("map_readers.py")))
MAX_FILES = 256  # Open files of the service; with 1024, the faults take more connections.
DAY_S = 86400.0
MAX_STARTS = 4  # Starts of a process without a connection after which it counts as lost.


# --- keys -----------------------------------------------------------------------------------------
def empty_messages_with_keys(role: str, topic: str, actor: str) -> bool:
    with new_folder() as folder:
        authority = found("AuthorityOfKeys").new(folder / "keys", 30)
        keys = {r: authority.add(r, r, "robot", 30) for r in ("service", "operator", role)}
        access = (folder / "keys" / "access.yaml").read_text()
        (keys["service"] / "access.yaml").write_text(access)
        with (
            Serve(folder, keys=keys["service"]) as serve,
            serve.running(keys["operator"]),
            serve.session(keys[role]) as sender,
        ):
            time.sleep(2.0)  # The session receives the subscriptions of the service.
            sent_s = time.monotonic()
            for epoch in range(1, 6):
                for seq in (0, 2**62 - 1):
                    put(sender, topic, b"", header(seq, epoch=epoch))

            def is_handled() -> bool:
                inputs = serve.health[actor]["inputs"]
                return any(i["topic"] == topic and i["rejected"] for i in inputs)

            ended = serve.ends_before("messages are rejected", is_handled)
            if not ended:
                serve.forget_heartbeats()
                ended = serve.ends_before("heartbeats", serve.new_heartbeats)
        code, took_s = serve.process.returncode, time.monotonic() - sent_s
        print(f"exit code {code} after {took_s:.1f} s" if ended else "rejected, all actors run")
        return ended and code != 0


def empty_messages_of_a_camera() -> bool:
    """Ten empty messages end the service, with the keys of a camera."""
    return empty_messages_with_keys("camera", "camera/rgbd", "frame_source")


def empty_messages_of_an_odometry() -> bool:
    """Ten empty messages end the service, with the keys of an odometry."""
    return empty_messages_with_keys("odometry", "odometry/prior", "tracker")


def loses_optimizer(until_s: float) -> bool:
    """Run a service with a certificate that is valid for one day, which does not last for the run.

    Args:
        until_s: End of the day, seconds from now.

    Returns:
        Whether the optimizer, which has a process of its own, loses its connection: the service
        ends, or starts the process again and again. Otherwise, the optimizer must send heartbeats
        for 20 s while the certificate is not valid.
    """
    port, start = free_port(), datetime.now(UTC) + timedelta(seconds=until_s - DAY_S)
    invalid_s = time.monotonic() + (until_s if 0 < until_s < DAY_S else 0.0)
    with new_folder() as folder:
        authority = found("AuthorityOfKeys").new(folder / "keys", 30)
        keys = authority.add("robot", "service", "robot", 1, now=start)
        with Serve(folder, name("--metrics-port"), str(port), keys=keys) as serve:

            def has_link() -> bool:
                return serve.heartbeat_age_s("optimizer", port) < 5.0

            if invalid_s > time.monotonic():
                serve.wait("the optimizer runs", has_link)
                if time.monotonic() > invalid_s:
                    raise NotObserved("the certificate expired before all actors were running")
            since_s, pids = float("inf"), set[int]()

            def has_result() -> bool:
                nonlocal since_s
                now_s = time.monotonic()
                if has_link():
                    since_s = min(since_s, now_s)
                    pids.clear()
                else:
                    since_s = float("inf")
                    pids.update(processes_of("optimizer", serve))
                # Existing connections last for some seconds after the end of the validity.
                return now_s > max(since_s + 20.0, invalid_s + 60.0) or len(pids) >= MAX_STARTS

            serve.ends_before("heartbeats of the optimizer", has_result, 800.0)
            code, after_s = serve.process.poll(), time.monotonic() - invalid_s
            if len(pids) < MAX_STARTS and code is None:
                print("all actors run")
                return False
            print(f"{len(pids)} starts of the optimizer, exit code {code} after {after_s:.0f} s")
            return code != 0


def processes_of(actor: str, serve: Serve) -> set[int]:
    """Return the running child processes of a service that run an actor."""
    pids = set[int]()
    for pid in children_of(serve.process.pid):
        with suppress(OSError):
            if actor.encode() in Path(f"/proc/{pid}/cmdline").read_bytes().split(b"\0"):
                pids.add(pid)
    return pids


def expiring_certificate() -> bool:
    """The optimizer loses its connection when the certificate of the service expires."""
    return loses_optimizer(120.0)


def expired_certificate() -> bool:
    """The optimizer does not connect if the certificate of the service is expired."""
    return loses_optimizer(-DAY_S)


def future_certificate() -> bool:
    """The optimizer does not connect if the certificate of the service is not valid yet."""
    return loses_optimizer(2 * DAY_S)


# --- readers --------------------------------------------------------------------------------------
@contextmanager
def readers(serve: Serve, count: int) -> Iterator[None]:
    """Let `count` readers read the map inside a `with` block."""
    command = [*READERS, serve.endpoint, str(count)]
    program = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert program.stdout
        assert program.stdout.readline()
        yield
    finally:
        program.kill()
        program.communicate()


def map_readers() -> bool:
    """Commands are refused while 20 programs read the map."""
    with new_folder() as folder, Serve(folder, settings=LIGHT) as serve, serve.running() as session:
        map_keyframes(serve, session, Camera(list(frames(30, 3))), 16)
        if not control(session, "pause")[0]:
            raise NotObserved("a command is refused without readers")
        with readers(serve, 20):
            time.sleep(5.0)  # The readers connect and read.
            answers = [control(session, ("resume", "pause")[number % 2]) for number in range(20)]
        refused = [text for is_done, text in answers if not is_done]
        print(f"{len(refused)} of {len(answers)} commands not carried out {set(refused) or ''}")
        return bool(refused)


# --- idle connections -----------------------------------------------------------------------------
def open_files(serve: Serve) -> int:
    return len(os.listdir(f"/proc/{serve.process.pid}/fd"))


def unsaved_with_idle_readers() -> bool:
    """Idle connections to the metrics server take all descriptors, so nothing is saved."""
    port = free_port()
    arguments = (name("--metrics-port"), str(port))
    with (
        new_folder() as folder,
        Serve(folder, *arguments, settings=LIGHT, max_files=MAX_FILES) as serve,
        serve.running() as session,
        ExitStack() as stack,
    ):
        map_keyframes(serve, session, Camera(list(frames(20, 3))), 4)
        opened = 0
        for _ in range(MAX_FILES + 50):
            try:
                one = socket.create_connection(("127.0.0.1", port), timeout=5)
            except OSError:
                break
            opened += 1
            stack.callback(one.close)
            time.sleep(0.02)  # The server has a queue of five connections.
        if opened < MAX_FILES / 2:
            raise NotObserved(f"only {opened} connections were opened")
        is_saved, text = control(session, "save", 60.0)
        problem = "" if is_saved else f"; not saved: {text[:60]}"
        print(f"{opened} connections, {open_files(serve)} of {MAX_FILES} files open{problem}")
        return not is_saved


class Flood:
    """Idle connections to a TLS port, which are opened again when they are closed."""

    def __init__(self, port: int, most: int) -> None:
        self._port, self._most = port, most
        self._stop, self._held = Event(), list[socket.socket]()
        self.opened = 0

    @contextmanager
    def running(self) -> Iterator["Flood"]:
        thread = Thread(target=self._run)
        thread.start()
        try:
            yield self
        finally:
            self._stop.set()
            thread.join()
            for one in self._held:
                one.close()

    def _run(self) -> None:
        while not self._stop.wait(0.1):
            self._held = [one for one in self._held if is_open(one)]
            for _ in range(min(60, self._most - len(self._held))):
                with suppress(OSError):
                    one = socket.create_connection(("127.0.0.1", self._port), timeout=0.3)
                    self._held.append(one)
                    self.opened += 1


def is_open(connection: socket.socket) -> bool:
    """Return whether the other side has not closed a connection; if it has, close it here too."""
    connection.setblocking(False)
    try:
        if connection.recv(1):
            return True
    except BlockingIOError:
        return True
    except OSError:
        pass
    connection.close()
    return False


def unsaved_with_idle_tls_connections() -> bool:
    """Idle connections without keys take all descriptors, so nothing is saved."""
    with new_folder() as folder:
        authority = found("AuthorityOfKeys").new(folder / "keys", 30)
        keys = {role: authority.add(role, role, "robot", 30) for role in ("service", "operator")}
        access = (folder / "keys" / "access.yaml").read_text()
        (keys["service"] / "access.yaml").write_text(access)
        with (
            Serve(folder, keys=keys["service"], max_files=MAX_FILES) as serve,
            serve.running(keys["operator"]) as session,
            Flood(serve.port, MAX_FILES + 60).running() as flood,
        ):
            serve.wait(
                "all descriptors are used, or many connections are closed again",
                lambda: open_files(serve) >= MAX_FILES - 4 or flood.opened > 4 * MAX_FILES,
            )
            most = open_files(serve)
            is_saved, text = control(session, "save", 60.0)
            problem = "" if is_saved else f"; not saved: {text[:60]}"
            print(f"{flood.opened} connections, {most} of {MAX_FILES} files open{problem}")
            return not is_saved


PROGRAMS: dict[str, Callable[[], bool]] = {
    program.__name__: program
    for program in (
        empty_messages_of_a_camera,
        empty_messages_of_an_odometry,
        expiring_certificate,
        expired_certificate,
        future_certificate,
        map_readers,
        unsaved_with_idle_readers,
        unsaved_with_idle_tls_connections,
    )
}

if __name__ == "__main__":
    run(PROGRAMS, __file__)
