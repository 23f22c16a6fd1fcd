"""Fuzz targets for files that the service and its runs write and read again."""

import json
import tempfile
from collections.abc import Callable, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.errors import DataError, LdoError
from ldo_service.gaussians import chunk, training_views
from ldo_service.gaussians.file_formats import read_ply, write_ply
from ldo_service.gaussians.model import new_labels
from ldo_service.geometry import Camera, codecs
from ldo_service.recordings.mcap_file import RecordConfig, RecordingFile
from ldo_service.runs.finished import MapFolder, read_run, vlm_calls
from ldo_service.runs.recorded_sequence import RecordingSequence
from ldo_service.runs.records import OBJECTS, read_loops, read_objects, write_objects
from ldo_service.runs.replayed import open_recording
from ldo_service.runtime.journal import Started, StepRecord, checksum
from ldo_service.schemas import CameraRgbd, MapObjects
from ldo_service.semantics.semantics_file import read_semantics, write_semantics
from ldo_service.storage.state_codec import decode_state, encode_state
from ldo_service.storage.state_contents import UNCHECKED_VERSION, StateContents, check_of
from ldo_service.storage.state_store import FolderStore
from ldo_service.tracking.keyframe_database import DATABASE_FILE, KeyframeRecord
from ldo_service.tracking.localizer import load_keyframe_database
from tests.schemas.examples import EXAMPLES

from .dataset_targets import DEPTH, TRAJECTORY, png
from .target import Target, as_file, in_folder

ROWS = np.random.default_rng(7).normal(size=(3, 16)).astype(np.float32)
CAMERA = {"width": 40, "height": 32, "fx": 40.0, "fy": 41.0, "cx": 19.5, "cy": 15.5}
KEYFRAME = {
    "keyframe": 0,
    "frame_index": 0,
    "stamp_ns": 0,
    "camera": CAMERA,
    "T_map_camera": np.eye(4).tolist(),
    "exposure": [[1, 1, 1], [0, 0, 0]],
    "submap": 0,
}
LOOPS = {
    "candidates": [
        {"keyframes": [4], "reference_keyframes": [1], "rejected_reason": "", "ms": 1.5}
    ],
    "closures": [{"keyframe": 4, "reference": 1, "T_reference_keyframe": np.eye(4).tolist()}],
}
FRAMES = b"frame,stamp_ns,status,held_out\n0,0,OK,0\n1,33333333,LOST,1\n"


def bytes_of(write: Callable[[Path], object]) -> bytes:
    """Return the bytes that `write` writes to a file."""
    with tempfile.TemporaryDirectory() as folder:
        write(Path(folder) / "file")
        return (Path(folder) / "file").read_bytes()


# --- maps -----------------------------------------------------------------------------------------
def as_text_ply(body: bytes) -> bytes:
    """Return a PLY file in text with the properties of a binary one."""
    header, _, _ = body.partition(b"end_header\n")
    header = header.replace(b"binary_little_endian", b"ascii")
    return header + b"end_header\n" + b"\n".join(b"1 " * header.count(b"property") for _ in ROWS)


def objects_bytes() -> bytes:
    objects = EXAMPLES["map_objects"]
    assert isinstance(objects, MapObjects)
    with tempfile.TemporaryDirectory() as folder:
        write_objects(Path(folder), objects)
        return (Path(folder) / OBJECTS).read_bytes()


def keyframes_file(folder: Path) -> None:
    run = MapFolder(folder)
    run.viewpoints()
    run.exposures()
    run.keyframes()


def images_of_a_keyframe() -> bytes:
    color = np.arange(3 * 48, dtype=np.uint8).reshape(3, 6, 8)
    depth_m = np.linspace(0.5, 3, 48, dtype=np.float32).reshape(6, 8)
    camera = Camera(8, 6, 8.0, 8.0, 3.5, 2.5)
    return training_views.pack(training_views.KeyframeImages(3, camera, color, depth_m, None))


def gaussians_of_a_chunk() -> bytes:
    ids = np.arange(3, dtype=np.int64)
    return chunk.pack(chunk.Chunk(2, ids, ROWS, new_labels(3)))


def database_bytes() -> bytes:
    """Return a keyframe database with one keyframe and two features."""
    place = KeyframeRecord(
        id=0,
        submap=0,
        T_odom_keyframe=np.eye(4),
        median_depth_m=1.5,
        intensity_sigma=2.0,
        depth_noise_scale=1.0,
        thumbnail=np.zeros(300, np.int8),
        points_camera=np.ones((2, 3), np.float32),
        descriptors=np.zeros((2, 32), np.uint8),
        camera=Camera(*CAMERA.values()),
        gray=png(DEPTH.astype(np.uint8)),
        depth=codecs.encode_depth(DEPTH)[1],
    )
    return encode_state({"places": [place.pack()]})


MAP = bytes_of(lambda path: write_ply(path, ROWS))
SEMANTICS = bytes_of(lambda path: write_semantics(path, new_labels(3), ("background", "other")))
RUN = {
    "map.ply": MAP,
    "frames.csv": FRAMES,
    "trajectory.txt": TRAJECTORY,
    "trajectory_online.txt": TRAJECTORY,
    "keyframes.json": json.dumps([KEYFRAME]).encode(),
    "loops.json": json.dumps(LOOPS).encode(),
    "summary.json": b'{"labeller_requests": 3}',
    "semantics.npz": SEMANTICS,
}


# --- recordings and states ------------------------------------------------------------------------
def record(path: Path, stamp_ns: int = 2) -> None:
    """Write a recording of one camera frame and the step that handled it."""
    body = msgspec.msgpack.encode(EXAMPLES["camera_rgbd"])
    file = RecordingFile(path, {"config": "tracker: {hold_out: 5}"}, RecordConfig())
    file.add_entry(Started(step=0, state={"last_stamp_ns": encode_state(1)}))
    file.add("camera/rgbd", CameraRgbd, body, 0, stamp_ns)
    step = StepRecord(step=0, kind="done", taken=0, topic="camera/rgbd", checksum=checksum(body))
    file.add_entry(step)
    file.close()


def chunked(body: bytes) -> bytes:
    """Return a recording rewritten with the MCAP library, as other tools write it."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    out = BytesIO()
    writer = Writer(out)
    writer.start()
    ids: dict[str, int] = {}
    for _, channel, message in make_reader(BytesIO(body)).iter_messages():
        topic = channel.topic
        ids[topic] = ids.get(topic) or writer.register_channel(topic, channel.message_encoding, 0)
        writer.add_message(ids[topic], message.log_time, message.data, message.publish_time)
    writer.finish()
    return out.getvalue()


def replay_folder(folder: Path) -> None:
    """Replay a recording as `ldo replay` does; a difference is a valid result."""
    for actor in open_recording(folder):
        actor.caveats()
        actor.verify()


def frames_of(folder: Path) -> None:
    sequence = RecordingSequence(folder)
    for index in range(min(2, len(sequence))):
        sequence[index]


def load_state(folder: Path) -> None:
    """Load the state of an actor; a damaged one is a `DamagedStateError`."""
    FolderStore(folder).load("actor")


def states() -> Iterator[bytes]:
    yield encode_state({"sum": 3, "text": "a", "none": None, "list": [1, 2.5]})
    yield encode_state({"array": np.arange(6, dtype=np.float32).reshape(2, 3)})
    yield encode_state(np.float64(2.5))


# A state without checksums, so that damaged parts reach the decoder.
CONTENTS = msgspec.msgpack.encode({"files": {"sum": "sum.a"}, "version": UNCHECKED_VERSION})
CHECKED = StateContents({"sum": "sum.a"}, checks={"sum": check_of(next(states()))}).encode()
STATE = {"actor/contents.msgpack": CONTENTS, "actor/sum.a": next(states())}
RECORDING = bytes_of(record)

of_packed: tuple[type[Exception], ...] = (DataError,)
VOCABULARY_ERRORS = (LdoError, msgspec.DecodeError, ValueError, KeyError, TypeError)


def vocabulary(body: bytes, _folder: Path) -> Any:
    return Vocabulary.unpack(decode_state(body))


TARGETS = [
    Target("PLY", as_file("map.ply", read_ply), [MAP, as_text_ply(MAP)]),
    Target("labels of a map", as_file("s.npz", read_semantics), [SEMANTICS]),
    Target("objects.json", in_folder(OBJECTS, read_objects, {}), [objects_bytes()]),
    Target("places", in_folder(DATABASE_FILE, load_keyframe_database, {}), [database_bytes()]),
    Target("summary.json", in_folder("summary.json", vlm_calls, {}), [RUN["summary.json"]]),
    Target("loops.json", in_folder("loops.json", read_loops, {}), [RUN["loops.json"]]),
    Target(
        "keyframes.json", in_folder("keyframes.json", keyframes_file, RUN), [RUN["keyframes.json"]]
    ),
    *(
        Target(f"run: {name}", in_folder(name, read_run, RUN), [body])
        for name, body in RUN.items()
        if name not in ("summary.json", "trajectory_online.txt")
    ),
    Target(
        "images of a keyframe",
        lambda body, _: training_views.unpack(body),
        [images_of_a_keyframe()],
    ),
    Target("chunk of Gaussians", lambda body, _: chunk.unpack(body), [gaussians_of_a_chunk()]),
    Target(
        "recording",
        in_folder("frame_source.mcap", replay_folder, {}),
        [RECORDING, chunked(RECORDING)],
    ),
    Target(
        "recording as a data set",
        in_folder("frame_source.mcap", frames_of, {}),
        [RECORDING, chunked(RECORDING)],
    ),
    Target("state", in_folder("actor/sum.a", load_state, STATE), list(states())),
    Target(
        "contents of a state",
        in_folder("actor/contents.msgpack", load_state, STATE),
        [CONTENTS, CHECKED],
    ),
    Target(
        "vocabulary", vocabulary, [msgspec.msgpack.encode(Vocabulary().pack())], VOCABULARY_ERRORS
    ),
]
