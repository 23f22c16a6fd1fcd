"""Regression tests of fuzzing: each of these bodies once raised an unexpected error."""

import logging
import re
import struct
from pathlib import Path

import msgspec
import pytest

from ldo_service.storage.state_contents import UNCHECKED_VERSION

from .dataset_targets import COLOR as IMAGE
from .dataset_targets import MCAP, METADATA, STRAY, jpeg, png
from .run_folder_targets import RUN, SEMANTICS, bytes_of, gaussians_of_a_chunk, record
from .targets import TARGETS

DEEP_JSON, DEEP_YAML, DEEP_MSGPACK = b'{"a": ' * 100_000, b"{a: " * 3000, b"\x91" * 100_000
INVALID_UTF8 = b"\xff\xfe\x80"
LONG_CHUNK = png(IMAGE)[:8] + struct.pack(">I4s", 4_000_000_000, b"IDAT") + bytes(300)
LARGE_JPEG = jpeg(IMAGE).replace(struct.pack(">HH", *IMAGE.shape[:2]), b"\x7f\xff" * 2)
LOOPS = RUN["loops.json"]
ENCRYPTED = re.sub(rb"(PK\x01\x02.{4})..", b"\\g<1>\x01\x00", SEMANTICS, flags=re.DOTALL)
CHUNK = gaussians_of_a_chunk()
# The channel, the number and both times of the first message; its time is outside its chunk.
FIRST, LATE = struct.pack("<HIQQ", 1, 0, 1, 1), struct.pack("<HIQQ", 1, 0, 1 << 32, 1)
LARGE_CHUNK = CHUNK[:4] + b"\xe0" + b"\xff" * 7 + b"\x0f" + CHUNK[6:]  # The stated size is 10^18.

FOUND = [
    ("Replica: traj.txt", INVALID_UTF8),
    ("Replica: cam_params.json", DEEP_JSON),
    ("TUM: rgb.txt", b"0.1 rgb/\0.png\n"),
    ("TUM: rgb.txt", b"99999999999999999999 rgb/a.png\n"),
    ("TUM: rgb.txt", b"1e999999 rgb/a.png\n"),
    ("Stray Scanner: odometry.csv", b"timestamp, frame\n1e999999, 0\n"),
    ("Stray Scanner: rgb.mp4", STRAY["rgb.mp4"].replace(b"avc1", b"none")),
    ("TUM: rgb/a.png", LONG_CHUNK + b"IEND\xaeB`\x82"),
    ("Replica: results/frame000000.jpg", LARGE_JPEG),
    ("images", bytes([40, 32, 3]) + LONG_CHUNK),
    ("about.json", b'{"sha256": "' + INVALID_UTF8 + b'"}'),
    ("objects.json", DEEP_JSON),
    ("loops.json", DEEP_JSON),
    ("keyframes.json", DEEP_JSON),
    ("summary.json", DEEP_JSON),
    ("run: frames.csv", b"a" * 200_000),
    ("images of a keyframe", b"\x81\xa1a" * 100_000),
    ("places", DEEP_MSGPACK),
    ("state", DEEP_MSGPACK),
    ("state", msgspec.msgpack.encode(msgspec.msgpack.Ext(1, b"\x93\xa3<q9\x91\x01\xc4\x01\0"))),
    (
        "contents of a state",
        msgspec.msgpack.encode({"files": {"sum": "\0"}, "version": UNCHECKED_VERSION}),
    ),
    ("state", bytes.fromhex("d80193a32c666390c4080000008000009a0440")),  # The type is ",fc".
    ("labels of a map", ENCRYPTED),
    ("loops.json", LOOPS.replace(b'"reference": 1', b'"reference": 1e999')),
    ("keyframes.json", RUN["keyframes.json"].replace(b'"keyframe": 0', b'"keyframe": 1e999')),
    ("chunk of Gaussians", LARGE_CHUNK),
    ("recording as a data set", bytes_of(lambda path: record(path, stamp_ns=2**63))),
    ("bag in MCAP", MCAP.replace(FIRST, LATE)),
    ("metadata of a bag", METADATA.replace(b"message_count: 2", b"message_count: null")),
    ("config.yaml", DEEP_YAML),
    ("config.yaml", b"tracker: 2027-13-45\n"),
    ("--set", b"tracker.hold_out=" + b"[" * 3000),
    ("suite", DEEP_YAML),
    ("access.yaml", b"[" * 100_000),  # This body ended the process.
    ("access.yaml", b'"\\ud800": {role: camera, robot: mule}'),
    ("names that a network carries", b"{['a', 0]: ''}"),
    ("access.yaml", b"a: {role: camera, robot: mule, until: 2027-13-01}"),
]


@pytest.mark.parametrize(
    ("name", "body"), FOUND, ids=[f"{name} {number}" for number, (name, _) in enumerate(FOUND)]
)
def test_fixed_finding_raises_only_expected_errors(
    name: str, body: bytes, tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.CRITICAL + 1):
        TARGETS[name].attempt(body, tmp_path)
