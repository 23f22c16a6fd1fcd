"""Fuzz targets for user input: settings, suites, names, keys and networks."""

import gzip
import hashlib
import json
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path

import numpy as np
import yaml
from safetensors.numpy import save

from ldo_service.config import config_of, config_yaml, load_config
from ldo_service.detection.detectors import OnnxDetector
from ldo_service.detection.labellers.text_embeddings import CachedEmbeddings, read_tokenizer
from ldo_service.detection.model_registry import Models
from ldo_service.detection.vocabulary import class_names, read_names
from ldo_service.suites import load_suite
from ldo_service.transport.access_control import access_control, read_access
from ldo_service.transport.certificate_authority import CertificateAuthority
from ldo_service.transport.endpoint import Endpoint
from ldo_service.transport.keys import CA, CERTIFICATE, KEY, TlsKeys
from tests.detection.networks import SQUARES

from .run_folder_targets import bytes_of
from .target import Read, Target, as_file, in_folder

CONFIG = b"tracker:\n  hold_out: 5\nservice: {process_actors: [optimizer], max_message_mb: 60}\n"
SUITE = b"""title: Desks
sequences: {fr1: desk, room: "synthetic:room"}
variants: {as it is: [], fewer: [tracker.hold_out=2]}
figures: [ate_cm, fps]
seeds: [0, 1]
published: {other: {fr1: {ate_cm: 1.5}}}
"""
ACCESS = b"front-3f9a1c02: {role: camera, robot: mule, until: 2027-11-22}\n"
ABOUT = json.dumps(
    {"sha256": hashlib.sha256(b"x").hexdigest(), "layout": "yolox", "classes": ["a"], "parts": {}}
).encode()
MERGES = b"#version: 0.2\ni n\nt h\nth e</w>\n"
NAMES = np.array(["a", "b"])
EMBEDDINGS = np.eye(2, dtype=np.float32)


def config(path: Path) -> None:
    """Load a configuration; an accepted one must be the same after writing and reading it."""
    loaded = load_config(path)
    assert config_of(yaml.safe_load(config_yaml(loaded))) == loaded


def setting(body: bytes, _folder: Path) -> None:
    load_config(settings=(body.decode("utf-8", "replace"),))


def as_text(take: Callable[[str], object]) -> Read:
    return lambda body, _: take(body.decode("utf-8", "replace"))


def npz() -> bytes:
    out = BytesIO()
    np.savez(out, names=NAMES, embeddings=EMBEDDINGS, logit_scale=np.float32(4))
    return out.getvalue()


def rules(path: Path) -> None:
    access_control(read_access(path))


def registered(folder: Path) -> None:
    Models(folder).get("net").verify()


def keys(folder: Path) -> None:
    (folder / KEY).chmod(0o600)
    TlsKeys(folder).context()


def key_files() -> dict[str, bytes]:
    with tempfile.TemporaryDirectory() as name:
        authority = CertificateAuthority.new(Path(name) / "keys", 9)
        made = authority.add("desk", "viewer", "*", 9)
        return {file: (made / file).read_bytes() for file in (CA, CERTIFICATE, KEY)}


NET = {"net/model.onnx": b"x"}
KEYS = key_files()
NETWORK = bytes_of(SQUARES["yolox"].write)

TARGETS = [
    Target("config.yaml", as_file("config.yaml", config), [CONFIG]),
    Target("--set", setting, [b"tracker.hold_out=5", b"dataset.T_color_depth=[1, 0]"]),
    Target("suite", as_file("suite.yaml", lambda path: load_suite(str(path))), [SUITE]),
    Target("names of robots", as_text(Endpoint), [b"mule", b"../up"]),
    Target("endpoints", as_text(lambda text: Endpoint("r", text).address), [b"tcp/[::1]:7447"]),
    Target(
        "access.yaml",
        as_file("access.yaml", lambda path: access_control(read_access(path))),
        [ACCESS],
    ),
    *(Target(f"keys: {name}", in_folder(name, keys, KEYS), [body]) for name, body in KEYS.items()),
    Target(
        "about.json", in_folder("net/about.json", registered, {"net/model.onnx": b"x"}), [ABOUT]
    ),
    Target("ONNX", as_file("net.onnx", OnnxDetector), [NETWORK]),
    Target("names of classes", as_file("names.txt", read_names), [b"chair\nsofa\n"]),
    Target(
        "names that a network carries",
        as_text(lambda text: class_names(2, metadata=text)),
        [b"{0: 'chair', 1: 'sofa'}", b"['a', 'b']"],
    ),
    Target("byte pairs", as_file("bpe", read_tokenizer), [MERGES, gzip.compress(MERGES, mtime=0)]),
    Target("embeddings", as_file("e.npz", CachedEmbeddings), [npz()]),
    Target(
        "embeddings in safetensors",
        as_file("e.safetensors", CachedEmbeddings),
        [save({"embeddings": EMBEDDINGS}, {"names": "a\nb"})],
    ),
]
