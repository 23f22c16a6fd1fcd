"""Lines of `ldo doctor`; tests/service/test_health.py runs it with a service."""

import importlib.util
import tomllib
from collections.abc import Callable
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
from tests.kernels.gpu.saved_times import save_failure, save_times
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


@pytest.mark.parametrize(
    ("endpoint", "mark"), [("tcp/127.0.0.1:1", "absent"), ("127.0.0.1:7447", "bad")]
)
def test_malformed_endpoint_is_bad_and_a_service_that_does_not_run_is_absent(
    endpoint: str, mark: str
) -> None:
    (finding,) = doctor.service("robot", endpoint, None)
    assert finding.mark == mark
    assert endpoint in finding.text


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


def find(monkeypatch: pytest.MonkeyPatch, found: Callable[[], Gpu], tmp_path: Path) -> None:
    """Replace the search for a GPU, without a saved benchmark."""
    monkeypatch.setenv("LDO_CACHE", str(tmp_path))
    for module in ("kernels.gpu.device", "commands.doctor"):
        monkeypatch.setattr(f"ldo_service.{module}.find_gpu", found)


def test_devices_without_a_gpu_are_the_cpu(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    find(monkeypatch, missing_gpu, tmp_path)
    mapper, tracker, networks = doctor.devices()
    assert (mapper.mark, tracker.mark, networks.mark) == ("note", "note", "note")
    for actor, finding in (("mapper", mapper), ("tracker", tracker)):
        assert finding.text.startswith("service.device=auto chooses cpu (")
        assert finding.text.endswith(f"for the {actor}: there is no GPU.")
    assert "chooses cpu for the networks" in networks.text


def test_gpu_without_a_benchmark_is_experimental(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find(monkeypatch, gpu, tmp_path)
    mapper, tracker, _, experimental = doctor.devices()
    for finding in (mapper, tracker):
        assert finding.mark == "note"
        assert "chooses cpu (" in finding.text
        assert "`ldo bench --device cuda` has not run on Some GPU" in finding.text
    assert experimental.mark == "note"
    assert experimental.text.startswith(
        "the GPU Some GPU is experimental until `ldo bench --device cuda` has passed on it"
    )


def test_gpu_that_failed_the_benchmark_is_a_warning(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find(monkeypatch, gpu, tmp_path)
    save_failure(gpu(), "the loss differs.")
    mapper, _, _, benchmark = doctor.devices()
    assert "chooses cpu (" in mapper.text
    assert benchmark.mark == "warn"
    assert benchmark.text.startswith(
        "the GPU Some GPU has failed `ldo bench --device cuda`: the loss differs. Until it passes,"
    )


@pytest.mark.skipif(not TRITON, reason="`make gpu-check` installs Triton")
@pytest.mark.parametrize("actor", ["mapper", "tracker"])
def test_gpu_that_fails_the_self_test_is_a_warning(
    actor: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find(monkeypatch, gpu, tmp_path)
    save_times(gpu(), {"iteration": 9.0, "alignment": 9.0}, {"iteration": 1.0, "alignment": 1.0})
    for module in ("gaussians.gpu_self_test", "tracking.alignment_self_test"):
        monkeypatch.setattr(f"ldo_service.{module}.run_self_test", fail)
    (finding,) = (finding for finding in doctor.devices() if f"for the {actor}" in finding.text)
    assert finding.mark == "warn"
    assert finding.text.endswith("the GPU Some GPU failed: the loss differs.")


@pytest.mark.skipif(not TRITON, reason="`make gpu-check` installs Triton")
def test_gpu_that_was_faster_and_passes_the_self_test_is_chosen(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    find(monkeypatch, gpu, tmp_path)
    save_times(gpu(), {"iteration": 9.0, "alignment": 1.0}, {"iteration": 1.0, "alignment": 2.0})
    monkeypatch.setattr("ldo_service.gaussians.gpu_self_test.run_self_test", lambda _: None)
    mapper, tracker, _, benchmark = doctor.devices()
    assert (mapper.mark, tracker.mark, benchmark.mark) == ("ok", "note", "ok")
    assert "chooses cuda (Some GPU) for the mapper: the GPU passed the self-test." in mapper.text
    assert "1.00 ms per iteration on Some GPU, and 9.00 ms on the CPU" in mapper.text
    assert "2.00 ms per alignment on Some GPU, and 1.00 ms on the CPU" in tracker.text
    assert benchmark.text == (
        "the GPU Some GPU has passed `ldo bench --device cuda` (640x480 pixels)"
    )


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
