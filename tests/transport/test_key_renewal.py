"""Tests of a router whose TLS keys are replaced while it runs."""

import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import zenoh

from ldo_service.schemas.topics import CAMERA_RGBD, MAP_REFINE
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import LOOPBACK, Endpoint
from ldo_service.transport.gate_process import GateProcess, guarded
from ldo_service.transport.key_renewal import KeyRenewal
from ldo_service.transport.keys import ACCESS, CERTIFICATE, KEY, TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_port

PATIENCE_S = 60.0
PREFIX = "ldo/robot"


class RunningRouter:
    """Router behind a gate, with its certificate authority and a list of the arrived messages."""

    def __init__(self, folder: Path, stack: ExitStack) -> None:
        self.authority = CertificateAuthority.new(folder / "keys", days=60)
        for name, role in (("mule", "service"), ("front", "camera"), ("desk", "operator")):
            self.authority.add(name, role, "robot", days=20)  # type: ignore[arg-type]
        self.keys, self.port = folder / "keys", free_port()
        self.used = folder / "mule"
        shutil.copytree(self.keys / "mule", self.used)
        endpoint, link = f"tls/{LOOPBACK}:{self.port}", str(folder / "link")
        network = Endpoint("robot", endpoint, TlsKeys(self.used), local_socket=link)
        behind, gate = stack.enter_context(guarded(network))
        assert gate is not None
        session = stack.enter_context(open_session(behind, router=True))
        self.renewed: list[TlsKeys] = []
        stack.enter_context(KeyRenewal(gate, behind, self.renewed.append))
        self.outside = replace(network, local_socket="")
        self.arrived: list[str] = []
        for topic in (CAMERA_RGBD, MAP_REFINE):
            session.declare_subscriber(
                f"{PREFIX}/{topic.name}",
                zenoh.handlers.Callback(self._store, indirect=False),
            )

    def _store(self, sample: zenoh.Sample) -> None:
        self.arrived.append(str(sample.key_expr).removeprefix(f"{PREFIX}/"))

    def client(self, name: str) -> Endpoint:
        return replace(self.outside, keys=TlsKeys(self.keys / name))

    def install(self, name: str, *files: str) -> None:
        for file in files:
            shutil.copyfile(self.keys / name / file, self.used / file)

    def valid_days(self) -> float:
        keys = TlsKeys(self.keys / "desk")
        until_s = keys.server_valid_until_s(LOOPBACK, self.port)
        return 0.0 if until_s is None else (until_s - time.time()) / 86_400


@pytest.fixture
def router(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[RunningRouter]:
    monkeypatch.setattr(KeyRenewal, "PERIOD_S", 0.1)
    with ExitStack() as stack:
        yield RunningRouter(tmp_path, stack)


def eventually(is_true: Callable[[], object]) -> None:
    until_s = time.monotonic() + PATIENCE_S
    while not is_true():
        assert time.monotonic() < until_s, "the condition was not met in time"
        time.sleep(0.02)


def arrives(router: RunningRouter, session: zenoh.Session, topic: str) -> Callable[[], bool]:
    """Return a function that puts a message and returns whether one has arrived since then."""
    before = len(router.arrived)

    def has_arrived() -> bool:
        session.put(f"{PREFIX}/{topic}", b"1")
        return topic in router.arrived[before:]

    return has_arrived


def test_replaced_keys_are_used_and_connected_programs_continue(router: RunningRouter) -> None:
    with open_session(router.client("front")) as camera:
        eventually(arrives(router, camera, CAMERA_RGBD.name))
        assert 19 < router.valid_days() < 21
        for days in (40, 50):  # The second renewal replaces the router of the first one.
            router.authority.add(f"mule-{days}", "service", "robot", days=days)
            router.install(f"mule-{days}", CERTIFICATE, KEY, ACCESS)
            eventually(lambda days=days: abs(router.valid_days() - days) < 1)
            eventually(arrives(router, camera, CAMERA_RGBD.name))
    assert len(router.renewed) == 2


def test_revoked_keys_are_denied_without_a_restart(router: RunningRouter) -> None:
    shutil.copytree(router.keys / "desk", router.keys / "stolen")
    with open_session(router.client("front")) as camera, ExitStack() as stack:
        desk = stack.enter_context(open_session(router.client("desk")))
        eventually(arrives(router, desk, MAP_REFINE.name))
        router.authority.remove("desk")
        router.install("mule", ACCESS)
        eventually(lambda: router.renewed)
        thief = stack.enter_context(open_session(router.client("stolen")))
        arrived = len(router.arrived)
        for _ in range(20):
            for session in (thief, desk):
                session.put(f"{PREFIX}/{MAP_REFINE.name}", b"1")
            eventually(arrives(router, camera, CAMERA_RGBD.name))
        assert MAP_REFINE.name not in router.arrived[arrived:]


def test_unusable_new_keys_leave_the_previous_ones_in_use(
    router: RunningRouter, caplog: pytest.LogCaptureFixture
) -> None:
    with open_session(router.client("front")) as camera:
        eventually(arrives(router, camera, CAMERA_RGBD.name))
        (router.used / CERTIFICATE).write_text("half a certificate")
        eventually(lambda: "cannot be used, so the previous ones stay in use" in caplog.text)
        eventually(arrives(router, camera, CAMERA_RGBD.name))
    assert not router.renewed


def test_corrected_mode_of_a_private_key_is_noticed(
    router: RunningRouter, caplog: pytest.LogCaptureFixture
) -> None:
    router.authority.add("mule-40", "service", "robot", days=40)
    (router.used / KEY).chmod(0o644)
    router.install("mule-40", CERTIFICATE, KEY, ACCESS)
    eventually(lambda: "is readable by all users" in caplog.text)
    assert not router.renewed
    (router.used / KEY).chmod(0o640)
    eventually(lambda: router.renewed)


def test_client_uses_replaced_keys_when_it_connects_again(tmp_path: Path) -> None:
    """A service with `--client` is such a client; the router starts again with a new list."""
    authority = CertificateAuthority.new(tmp_path / "keys", days=60)
    for name in ("router", "mule"):
        authority.add(name, "service", "robot", days=20)
    endpoint, arrived = f"tls/{LOOPBACK}:{free_port()}", []
    used = shutil.copytree(authority.folder / "mule", tmp_path / "mule")

    @contextmanager
    def open_router() -> Iterator[None]:
        keys = TlsKeys(authority.folder / "router")
        with open_session(Endpoint("robot", endpoint, keys), router=True) as session:
            session.declare_subscriber(
                f"{PREFIX}/{MAP_REFINE.name}",
                zenoh.handlers.Callback(arrived.append, indirect=False),
            )
            yield

    with ExitStack() as stack:
        with open_router():
            service = stack.enter_context(open_session(Endpoint("robot", endpoint, TlsKeys(used))))

            def arrives_now() -> bool:
                service.put(f"{PREFIX}/{MAP_REFINE.name}", b"1")
                return bool(arrived)

            eventually(arrives_now)
            authority.remove("mule")
            authority.add("mule-2", "service", "robot", days=20)
            for file in (CERTIFICATE, KEY):
                shutil.copyfile(authority.folder / "mule-2" / file, used / file)
            shutil.copyfile(authority.folder / ACCESS, authority.folder / "router" / ACCESS)
        arrived.clear()
        stack.enter_context(open_router())
        eventually(arrives_now)


def test_keys_are_looked_at_again_after_an_unexpected_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    renewals: list[int] = []

    def renew(_: KeyRenewal) -> None:
        renewals.append(len(renewals))
        if len(renewals) == 1:
            raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(KeyRenewal, "PERIOD_S", 0.01)
    monkeypatch.setattr(KeyRenewal, "_renew", renew)
    keys = SimpleNamespace(folder=tmp_path)
    network, gate = cast(Endpoint, SimpleNamespace(keys=keys)), cast(GateProcess, None)
    with KeyRenewal(gate, network, lambda _: None):
        (tmp_path / KEY).write_text("a key that only its owner can read")
        eventually(lambda: len(renewals) == 2)
    assert "could not be renewed; trying again" in caplog.text
