"""Lines of `ldo doctor`; tests/service/test_health.py runs it with a service."""

import importlib.util
import tomllib
from pathlib import Path
from typing import Literal

import msgspec
import pytest

from ldo_service.commands import doctor
from ldo_service.errors import ConfigError, DeviceError, LdoError
from ldo_service.kernels.gpu.arrays import HostArrays
from ldo_service.kernels.gpu.device import Gpu
from ldo_service.service.diagnostics import ActorStatus
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import TlsKeys
from ldo_service.transport.zenoh_transport import open_session
from tests.ports import free_port
from tests.service.test_diagnostics import health, inputs

TRITON = importlib.util.find_spec("triton") is not None


def test_missing_extra_is_named_with_its_install_command(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda _: None)
    for check in ("machine", "libraries", "devices", "networks", "service"):
        monkeypatch.setattr(doctor, check, lambda *_: ())
    doctor.doctor()
    out = capsys.readouterr().out
    for extra in doctor.EXTRAS:
        assert f".venv/bin/pip install -e '.[{extra}]'" in out


def test_missing_library_is_bad(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(doctor, "LIBRARIES", {"no-such-library": "no_such_library"})
    (finding,) = doctor.libraries()
    assert finding.mark == "bad"
    assert ".venv/bin/pip install -e ." in finding.text


def test_bad_line_ends_with_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    for check in ("machine", "libraries", "extras", "devices", "networks"):
        monkeypatch.setattr(doctor, check, lambda: ())
    monkeypatch.setattr(doctor, "service", lambda *_: [doctor.Finding("bad", "tracker stopped")])
    with pytest.raises(LdoError, match="problems found: 1"):
        doctor.doctor()


def test_dropped_messages_are_named_by_topic() -> None:
    corrections, boxes = inputs("graph/correction", dropped=59), inputs("detection/boxes")
    message = msgspec.structs.replace(health(), inputs=(*corrections, *boxes))
    (finding,) = doctor.of_actor(ActorStatus("mapper", True, message, 1.5))
    assert ", 59 older graph/correction replaced by newer ones, 0 lost" in finding.text
    (finding,) = doctor.of_actor(ActorStatus("mapper", True, health(), 1.5))
    assert ", 0 dropped, " in finding.text


@pytest.mark.parametrize("check", ["calibration", "forecast"])
def test_check_of_a_folder_without_a_folder_is_an_error(
    check: Literal["calibration", "forecast"],
) -> None:
    with pytest.raises(ConfigError, match=f"`ldo doctor {check}` needs a folder, as in"):
        doctor.doctor(check)


@pytest.mark.parametrize("window_s", [0.0, float("nan"), float("inf")])
def test_window_must_be_positive_and_finite(window_s: float) -> None:
    with pytest.raises(ConfigError, match=f"--window-s {window_s:g} must be positive and finite"):
        doctor.doctor(window_s=window_s)


def test_every_extra_of_the_package_is_checked() -> None:
    pyproject = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())
    assert set(doctor.EXTRAS) == set(pyproject["project"]["optional-dependencies"])


@pytest.mark.parametrize(("found", "mark"), [(object(), "ok"), (None, "absent")])
def test_extra_for_a_gpu_is_called_experimental(
    monkeypatch: pytest.MonkeyPatch, found: object, mark: str
) -> None:
    monkeypatch.setattr("importlib.util.find_spec", lambda _: found)
    (finding,) = [finding for finding in doctor.extras() if "extra cuda" in finding.text]
    assert finding.mark == mark
    assert "experimental until `ldo bench --device cuda` has passed" in finding.text


def gpu(*_: object) -> Gpu:
    return Gpu("Some GPU", {}, HostArrays())


def missing_gpu() -> Gpu:
    raise DeviceError("there is no GPU.")


def fail(*_: object) -> None:
    raise DeviceError("the loss differs.")


def test_devices_without_a_gpu_are_the_cpu(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", missing_gpu)
    mapper, tracker, networks = doctor.devices()
    assert (mapper.mark, tracker.mark, networks.mark) == ("note", "note", "note")
    assert "for the tracker: no GPU has been measured to be faster" in tracker.text
    assert mapper.text.startswith("service.device=auto chooses cpu (")
    assert mapper.text.endswith("for the mapper: there is no GPU.")
    assert "chooses cpu for the networks" in networks.text


@pytest.mark.skipif(not TRITON, reason="`make gpu-check` installs Triton")
def test_gpu_that_fails_the_self_test_is_a_warning(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", gpu)
    monkeypatch.setattr("ldo_service.gaussians.gpu_self_test.run_self_test", fail)
    mapper, *_ = doctor.devices()
    assert mapper.mark == "warn"
    assert mapper.text.endswith("the GPU Some GPU failed: the loss differs.")


@pytest.mark.skipif(not TRITON, reason="`make gpu-check` installs Triton")
def test_gpu_that_passes_the_self_test_is_chosen(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.kernels.gpu.device.find_gpu", gpu)
    monkeypatch.setattr("ldo_service.gaussians.gpu_self_test.run_self_test", lambda _: None)
    mapper, *_ = doctor.devices()
    assert mapper.mark == "ok"
    assert "chooses cuda (Some GPU) for the mapper: the GPU passed the self-test." in mapper.text


@pytest.mark.parametrize(("days", "mark"), [(40, "ok"), (10, "warn")])
def test_certificates_that_expire_within_30_days_are_warnings(
    tmp_path: Path, days: int, mark: str
) -> None:
    authority = CertificateAuthority.new(tmp_path / "keys", days=50)
    for role in ("service", "viewer"):
        authority.add(role, role, "robot", days=days)
    endpoint = f"tls/127.0.0.1:{free_port()}"
    network = Endpoint("robot", endpoint, TlsKeys(tmp_path / "keys" / "service"))
    with open_session(network, router=True):
        own, service = doctor.certificates(endpoint, tmp_path / "keys" / "viewer")
    assert (own.mark, service.mark) == (mark, mark)
    if mark == "warn":
        assert f"the certificate of the service on {endpoint} expires in 10.0 days" in service.text
        assert "`ldo keys`" in own.text
