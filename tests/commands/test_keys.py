"""The command `ldo keys`: certificates of robots and programs."""

from pathlib import Path

import yaml

from .test_cli import assert_one_paragraph, ldo


def test_keys_are_made_listed_and_revoked(capsys, tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    assert ldo(capsys, "keys", "init", keys)[0] == 0
    add = ("keys", "add", keys)
    code, out, _ = ldo(capsys, *add, "service", "mule", "--robot", "mule", "--host", "mule.local")
    assert code == 0
    assert str(keys / "mule") in out
    assert ldo(capsys, *add, "viewer", "desk", "--days", "7")[0] == 0
    _, out, _ = ldo(capsys, "keys", "list", keys)
    assert [line.split()[1] for line in out.splitlines() if "│" in line] == ["desk", "mule"]
    assert ldo(capsys, "keys", "remove", keys, "desk")[0] == 0
    _, out, _ = ldo(capsys, "keys", "list", keys)
    assert "desk" not in out


def test_router_configuration_has_the_access_rules_of_the_keys(capsys, tmp_path: Path) -> None:
    keys = tmp_path / "keys"
    ldo(capsys, "keys", "init", keys)
    ldo(capsys, "keys", "add", keys, "camera", "front", "--robot", "mule")
    code, out, _ = ldo(capsys, "keys", "router", keys, "--keys", "/keys", "--port", "7448")
    file = yaml.safe_load(out[out.index("mode:") :])
    assert code == 0
    assert file["listen"]["endpoints"] == ["tls/0.0.0.0:7448"]
    assert file["transport"]["link"]["tls"]["listen_private_key"] == "/keys/tls.key"
    assert file["access_control"]["default_permission"] == "deny"
    (subject,) = file["access_control"]["subjects"]
    assert subject["cert_common_names"][0].startswith("front-")


def test_existing_keys_are_not_overwritten(capsys, tmp_path: Path) -> None:
    ldo(capsys, "keys", "init", tmp_path / "keys")
    code, _, err = ldo(capsys, "keys", "init", tmp_path / "keys")
    assert code == 2
    assert_one_paragraph(err)
    assert "never overwritten" in err


def test_keys_folder_can_be_set_in_the_configuration(capsys, tmp_path: Path) -> None:
    setting = ("--set", f"service.keys={tmp_path}")
    code, _, err = ldo(capsys, "serve", "--endpoint", "tls/127.0.0.1:7447", *setting)
    assert code == 2
    assert f"{tmp_path}/ca.crt cannot be read" in err
    assert_one_paragraph(err)


def test_a_service_on_the_network_without_keys_is_refused(capsys) -> None:
    code, _, err = ldo(capsys, "serve", "--endpoint", "tcp/0.0.0.0:7447")
    assert code == 2
    assert_one_paragraph(err)
    assert "--insecure" in err
