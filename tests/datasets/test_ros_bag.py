"""Bags of ROS 1 and ROS 2 as sequences; rosbags writes the bags."""

import gc
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as Writer2

from ldo_service.datasets import Sequence, SequenceOptions, open_sequence
from ldo_service.datasets.bag_file import BagFile
from ldo_service.errors import ConfigError, DataError, FrameError
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.registration import register_depth
from tests.cameras.ros import STORE, cdr, header, image
from tests.runs.jobs import job

from .bags import (
    COLOR,
    COLOR_INFO,
    DEPTH,
    FRAME,
    KINDS,
    entries_of,
    info_of,
    lossless,
    write_bag,
)

CAMERA = Camera(24, 16, 20.0, 21.0, 11.5, 7.5, (0.1, -0.05, 0.001, 0.002, 0.01))
SMALL_DEPTH_CAMERA = Camera(12, 8, 10.0, 10.5, 5.5, 3.5)
PIXELS = np.random.default_rng(3).integers(0, 255, (16, 24, 3), np.uint8)
DEPTH_MM = np.full((16, 24), 1500, np.uint16)
T_COLOR_DEPTH = se3.exp(np.array([0.01, -0.02, 0.005, 0.015, 0.001, 0.0]))


def color_message(stamp_ns: int, frame_id: str = FRAME) -> Any:
    return image("rgb8", PIXELS, header(stamp_ns, frame_id))


def depth_message(stamp_ns: int, frame_id: str = FRAME, pixels: np.ndarray = DEPTH_MM) -> Any:
    return image("16UC1", pixels, header(stamp_ns, frame_id))


def small(
    stamps_ns: tuple[int, ...] = (10**9, 2 * 10**9), **topics: str
) -> list[tuple[int, str, Any]]:
    """Return the messages of a camera; `topics` gives topics other names, or "" to omit them."""
    names = {"color": COLOR, "depth": DEPTH, "info": COLOR_INFO, **topics}
    messages: list[tuple[int, str, Any]] = [(1, names["info"], info_of(CAMERA))]
    for stamp_ns in stamps_ns:
        messages += [
            (stamp_ns + 7, names["color"], color_message(stamp_ns)),
            (stamp_ns + 7, names["depth"], depth_message(stamp_ns + 10**7)),
        ]
    return [entry for entry in messages if entry[1]]


def static_transform(parent: str, child: str, T_parent_child: np.ndarray) -> Any:
    types = STORE.types
    q = se3.quaternion(T_parent_child[:3, :3])
    transform = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](*T_parent_child[:3, 3]),
        types["geometry_msgs/msg/Quaternion"](q[1], q[2], q[3], q[0]),
    )
    stamped = types["geometry_msgs/msg/TransformStamped"](header(0, parent), child, transform)
    return types["tf2_msgs/msg/TFMessage"]([stamped])


# --- content --------------------------------------------------------------------------------------
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("is_compressed", [False, True])
def test_bag_has_the_frames_that_were_written_in_any_order_of_reading(
    room: Sequence, tmp_path: Path, kind: str, is_compressed: bool
) -> None:
    sequence = open_sequence(
        str(write_bag(tmp_path, kind, entries_of(room, range(1, 7), is_compressed)))
    )
    assert sequence.camera == room.camera
    assert sequence.truth() is None
    assert sequence.stamps_ns.tolist() == room.stamps_ns[1:7].tolist()
    for index in (5, 0, 3, 4):
        read, written = sequence[index], room[index + 1]
        np.testing.assert_array_equal(read.color, written.color)
        tolerance_m = 0.0006 if is_compressed else 0.0
        np.testing.assert_allclose(read.depth_m, written.depth_m, rtol=0, atol=tolerance_m)


@pytest.mark.parametrize("kind", KINDS)
def test_run_over_a_lossless_bag_has_the_same_bytes_as_its_source(
    room: Sequence, tmp_path: Path, kind: str
) -> None:
    from ldo_service.runs.offline import run_offline

    bag = open_sequence(str(write_bag(tmp_path, kind, entries_of(room, range(8)))))
    for sequence, name in ((room, "of_source"), (bag, "of_bag")):
        run_offline(job(sequence, tmp_path / name, frames=8), lambda *_: None)
    for file in ("trajectory.txt", "map.ply"):
        found = [(tmp_path / name / file).read_bytes() for name in ("of_bag", "of_source")]
        assert found[0] == found[1]


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_kitchen_as_a_bag_has_the_same_trajectory(data: Path, tmp_path: Path, kind: str) -> None:
    from ldo_service.runs.offline import run_offline

    kitchen = open_sequence(str(data / "tum/kitchen"))
    bag = open_sequence(str(write_bag(tmp_path, kind, entries_of(kitchen, range(60)))))
    for sequence, name in ((kitchen, "of_source"), (bag, "of_bag")):
        run_offline(job(sequence, tmp_path / name, frames=60), lambda *_: None)
    texts = [(tmp_path / name / "trajectory.txt").read_bytes() for name in ("of_bag", "of_source")]
    assert texts[0] == texts[1]
    assert len(texts[0].splitlines()) >= 60


@pytest.mark.parametrize(("kind", "suffix"), [("mcap", ".mcap"), ("sqlite3", ".db3")])
def test_single_file_of_a_bag_is_enough(tmp_path: Path, kind: str, suffix: str) -> None:
    folder = write_bag(tmp_path, kind, small())
    sequence = open_sequence(str(folder / f"bag{suffix}"))
    assert len(sequence) == 2
    assert sequence.raw_camera == CAMERA
    assert (sequence.read(1).depth_m() == 1.5).all()


@pytest.mark.parametrize(
    ("plugin", "mode"),
    [
        (StoragePlugin.SQLITE3, CompressionMode.MESSAGE),
        (StoragePlugin.SQLITE3, CompressionMode.FILE),
        (StoragePlugin.MCAP, CompressionMode.STORAGE),
    ],
)
def test_compressed_bag_of_ros2_is_read(
    tmp_path: Path, plugin: StoragePlugin, mode: CompressionMode
) -> None:
    writer = Writer2(tmp_path / "bag", version=9, storage_plugin=plugin)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        for time_ns, topic, message in small():
            link = next((c for c in writer.connections if c.topic == topic), None)
            link = link or writer.add_connection(topic, message.__msgtype__, typestore=STORE)
            writer.write(link, time_ns, cdr(message))
    np.testing.assert_array_equal(open_sequence(str(tmp_path / "bag")).read(1).color, PIXELS)


@pytest.mark.parametrize("kind", ["mcap", "sqlite3"])
def test_bag_of_several_files_is_read_by_several_threads(
    room: Sequence, tmp_path: Path, kind: str
) -> None:
    """`ros2 bag record --max-bag-size` splits a bag like this."""
    first = write_bag(tmp_path, kind, entries_of(room, range(1, 5)), "first")
    second = write_bag(tmp_path, kind, entries_of(room, range(5, 9)), "second")
    (file,) = (path for path in second.iterdir() if path.name.startswith("second."))
    file.rename(first / file.name)
    metadata = yaml.safe_load((first / "metadata.yaml").read_text())
    about = metadata["rosbag2_bagfile_information"]
    about["relative_file_paths"].append(file.name)
    about["message_count"] *= 2
    for topic in about["topics_with_message_count"]:
        topic["message_count"] *= 2
    (first / "metadata.yaml").write_text(yaml.safe_dump(metadata))
    sequence = open_sequence(str(first))
    order = [7, 0, 3, 4] * 5
    with ThreadPoolExecutor(4) as threads:
        frames = list(threads.map(sequence.read, order))
    for index, frame in zip(order, frames, strict=True):
        np.testing.assert_array_equal(frame.color, room.read(index + 1).color)


@pytest.mark.parametrize("algorithm", list(Writer1.CompressionFormat))
def test_compressed_bag_of_ros1_is_read(
    tmp_path: Path, algorithm: Writer1.CompressionFormat, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = Writer1.open

    def open_compressed(writer: Writer1) -> None:
        writer.set_compression(algorithm)
        opened(writer)

    monkeypatch.setattr(Writer1, "open", open_compressed)
    path = write_bag(tmp_path, "ros1", small())
    assert f"compression={algorithm.name.lower()}".encode() in path.read_bytes()
    np.testing.assert_array_equal(open_sequence(str(path)).read(1).color, PIXELS)


@pytest.mark.parametrize("kind", KINDS)
def test_messages_with_one_time_of_recording_are_distinguished(tmp_path: Path, kind: str) -> None:
    entries = [(5, topic, message) for _, topic, message in small((10**9, 2 * 10**9, 3 * 10**9))]
    for number, (_, topic, message) in enumerate(entries):
        if topic == DEPTH:
            message.data[:2] = np.array([number], "<u2").view(np.uint8)
    sequence = open_sequence(str(write_bag(tmp_path, kind, entries)))
    assert [int(sequence.read(k).depth[0, 0]) for k in (2, 0, 1)] == [6, 2, 4]


@pytest.mark.parametrize("kind", KINDS)
def test_time_of_recording_replaces_a_stamp_of_zero(tmp_path: Path, kind: str) -> None:
    entries = [
        (1, COLOR_INFO, info_of(CAMERA)),
        *((t, COLOR, color_message(0)) for t in (30, 60)),
        *((t + 1, DEPTH, depth_message(0)) for t in (30, 60)),
    ]
    sequence = open_sequence(str(write_bag(tmp_path, kind, entries)))
    assert sequence.stamps_ns.tolist() == [30, 60]


def test_frames_ascend_by_stamp_and_are_paired_with_the_nearest_depth(tmp_path: Path) -> None:
    def stream(topic: str, make: Callable[[int], Any], stamps_ms: list[int]) -> Iterator[Any]:
        return ((k + 1, topic, make(t * 10**6)) for k, t in enumerate(stamps_ms))

    entries = [
        (1, COLOR_INFO, info_of(CAMERA)),
        *stream(COLOR, color_message, [133, 100, 100, 166, 400]),
        *stream(DEPTH, depth_message, [95, 140, 160, 350]),
    ]
    sequence = open_sequence(str(write_bag(tmp_path, "ros1", entries)))
    assert (sequence.stamps_ns // 10**6).tolist() == [100, 133, 166]


def test_file_is_closed_with_the_sequence(tmp_path: Path) -> None:
    bag = BagFile(write_bag(tmp_path, "ros1", small()))
    reader = bag._format._reader
    del bag
    gc.collect()
    assert reader.bio is None


# --- topics ---------------------------------------------------------------------------------------
@pytest.mark.parametrize(
    ("color", "depth", "info"),
    [
        ("/camera/rgb/image_color", "/camera/depth_registered/image", "/camera/rgb/camera_info"),
        (
            "/camera/rgb/image_raw",
            "/camera/depth_registered/hw_registered/image_rect_raw",
            "/camera/rgb/camera_info",
        ),
        ("/rgb/image_raw", "/depth_to_rgb/image_raw", "/rgb/camera_info"),
        ("/zed/rgb/image", "/zed/depth/image", "/zed/rgb/camera_info"),
        ("/oak/rgb/image_raw", "/oak/stereo/image_raw", "/oak/rgb/camera_info"),
        (
            "/depth_camera/color/image_raw",
            "/depth_camera/depth/image_raw",
            "/depth_camera/color/camera_info",
        ),
        ("/camera/image_raw", "/camera/depth/image_raw", "/camera/camera_info"),
    ],
)
def test_usual_names_are_found(tmp_path: Path, color: str, depth: str, info: str) -> None:
    other = [(3, "/camera/infra1/image_rect_raw", color_message(3))]
    path = write_bag(tmp_path, "ros1", small(color=color, depth=depth, info=info) + other)
    assert len(open_sequence(str(path))) == 2


def test_raw_and_registered_topics_are_preferred(tmp_path: Path) -> None:
    room = open_sequence("synthetic:room").read(1)
    entries = [
        *small(),
        *((9, topic, message) for topic, message in lossless(room, is_compressed=True)),
        (9, "/camera/depth/image_rect_raw", depth_message(9, "depth")),
    ]
    sequence = open_sequence(str(write_bag(tmp_path, "mcap", entries)))
    topics = [message.connection.topic for message in sequence._frames[0]]  # type: ignore[attr-defined]
    assert topics == [COLOR, DEPTH]


def test_topics_of_two_cameras_are_listed_and_an_option_chooses(tmp_path: Path) -> None:
    def renamed(name: str) -> list[tuple[int, str, Any]]:
        return [(t, topic.replace("camera/", f"{name}/", 1), m) for t, topic, m in small()]

    front, back = renamed("front"), renamed("back")
    path = str(write_bag(tmp_path, "sqlite3", [*front, *back]))
    with pytest.raises(DataError, match=r"several .*/back/.*, /front/.*--topic color=/back/color"):
        open_sequence(path)
    options = SequenceOptions(topics={"color": "/front/color/image_raw"})
    sequence = open_sequence(path, options)
    depths = [depth.connection.topic for _, depth in sequence._frames]  # type: ignore[attr-defined]
    assert depths == ["/front/aligned_depth_to_color/image_raw"] * 2
    with pytest.raises(ConfigError, match=r"--topic depth=/x names no .*/front/color"):
        open_sequence(path, SequenceOptions(topics={"depth": "/x"} | dict(options.topics)))


def test_topics_are_rejected_by_layouts_without_topics(tum_folder: Callable[..., Path]) -> None:
    with pytest.raises(ConfigError, match=r"has no topics\. Remove --topic"):
        open_sequence(str(tum_folder(["1"], ["1"])), SequenceOptions(topics={"color": "/a"}))


# --- registration ---------------------------------------------------------------------------------
DEPTH_RAW, DEPTH_RAW_INFO = "/camera/depth/image_rect_raw", "/camera/depth/camera_info"


def unregistered(*transforms: Any, frame_id: str = "depth") -> list[tuple[int, str, Any]]:
    depth_mm = np.full((8, 12), 1500, np.uint16)
    return [
        *small(depth=""),
        (1, DEPTH_RAW_INFO, info_of(SMALL_DEPTH_CAMERA, frame_id)),
        *((t, DEPTH_RAW, depth_message(t, frame_id, depth_mm)) for t in (10**9, 2 * 10**9)),
        *((k, "/tf_static", message) for k, message in enumerate(transforms, 1)),
    ]


@pytest.mark.parametrize("kind", KINDS)
def test_static_transforms_register_depth(tmp_path: Path, kind: str) -> None:
    transforms = (
        static_transform("link", FRAME, T_COLOR_DEPTH),
        static_transform("link", "depth_link", np.eye(4)),
        static_transform("depth_link", "depth", np.eye(4)),
    )
    path = write_bag(tmp_path, kind, unregistered(*transforms))
    frame = open_sequence(str(path)).read(1)
    depth_m = np.full((8, 12), 1.5, np.float32)
    expected = register_depth(depth_m, SMALL_DEPTH_CAMERA, CAMERA, se3.inverse(T_COLOR_DEPTH))
    np.testing.assert_allclose(frame.depth_m(), expected, atol=1e-6)
    assert (expected > 0).mean() > 0.5


def test_option_gives_the_transform_that_the_bag_lacks(tmp_path: Path) -> None:
    path = str(write_bag(tmp_path, "mcap", unregistered()))
    with pytest.raises(DataError, match=r"not registered .*'depth'.*align_depth.*T_color_depth"):
        open_sequence(path)
    frame = open_sequence(path, SequenceOptions(T_color_depth=T_COLOR_DEPTH)).read(0)
    depth_m = np.full((8, 12), 1.5, np.float32)
    expected = register_depth(depth_m, SMALL_DEPTH_CAMERA, CAMERA, T_COLOR_DEPTH)
    np.testing.assert_array_equal(frame.depth_m(), expected)


def test_depth_of_another_size_in_the_frame_of_color_is_registered(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", unregistered(frame_id=FRAME))
    frame = open_sequence(str(path)).read(0)
    assert frame.depth.shape == (16, 24)
    assert (frame.depth_m()[4:12, 6:18] == np.float32(1.5)).all()


def test_missing_camera_info_of_unregistered_depth_is_named(tmp_path: Path) -> None:
    entries = [entry for entry in unregistered(frame_id=FRAME) if entry[1] != DEPTH_RAW_INFO]
    path = write_bag(tmp_path, "ros1", entries)
    with pytest.raises(DataError, match=f"no camera info of {DEPTH_RAW}.*{DEPTH_RAW_INFO}"):
        open_sequence(str(path))


@pytest.mark.parametrize(
    ("unit", "units_per_m"), [("Float32", 2000.0), ("String", 2000.0), ("nothing", 1000.0)]
)
@pytest.mark.parametrize("lens", ["Brown Conrady", "Inverse Brown Conrady"])
def test_recording_of_realsense_viewer_has_its_depth_unit_and_extrinsics(
    tmp_path: Path, unit: str, units_per_m: float, lens: str
) -> None:
    """The topics and messages are those that librealsense 2.55 and 2.59 wrote."""
    sensors = "/device_0/sensor_0/Depth_0", "/device_0/sensor_1/Color_0"
    types, option = STORE.types, "/device_0/sensor_0/option/Depth_Units/value"
    identity = static_transform("", "", np.eye(4)).transforms[0].transform
    extrinsics = static_transform("", "", T_COLOR_DEPTH).transforms[0].transform
    brown = replace(info_of(CAMERA), distortion_model=lens)
    depth_mm = np.full((8, 12), 3000, np.uint16)
    entries = [
        (1, f"{sensors[1]}/info/camera_info", brown),
        (1, f"{sensors[0]}/info/camera_info", info_of(SMALL_DEPTH_CAMERA)),
        (1, f"{sensors[0]}/tf/1", identity),
        (1, f"{sensors[1]}/tf/1", extrinsics),
        (2, f"{sensors[0]}/image/data", image("mono16", depth_mm, header(5, "1"))),
        (2, f"{sensors[1]}/image/data", color_message(5, "1")),
    ]
    if unit == "Float32":
        entries.append((1, option, types["std_msgs/msg/Float32"](0.0005000000237487257)))
    elif unit == "String":
        entries.append((1, option, types["std_msgs/msg/String"]("0.000500")))
    path = write_bag(tmp_path, "ros1", entries, image_tail=np.float32(0.0005).tobytes())
    frame = open_sequence(str(path)).read(0)
    depth_m = np.full((8, 12), 3000 / units_per_m, np.float32)
    expected = register_depth(depth_m, SMALL_DEPTH_CAMERA, CAMERA, T_COLOR_DEPTH)
    np.testing.assert_allclose(frame.depth_m(), expected, atol=1e-6)
    assert frame.camera == CAMERA


def test_rectified_images_have_no_distortion(tmp_path: Path) -> None:
    names = {"color": "/camera/rgb/image_rect_color", "info": "/camera/rgb/camera_info"}
    sequence = open_sequence(str(write_bag(tmp_path, "ros1", small(**names))))
    assert sequence.raw_camera == CAMERA.rectified()


# --- damage ---------------------------------------------------------------------------------------
def reject(path: Path, match: str) -> None:
    with pytest.raises(DataError, match=match) as caught:
        open_sequence(str(path))
    assert "\n" not in str(caught.value)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(("kind", "file"), [("mcap", "bag.mcap"), ("sqlite3", "bag.db3")])
@pytest.mark.parametrize("is_folder", [True, False])
def test_truncated_and_empty_bags_of_ros2_are_rejected(
    tmp_path: Path, kind: str, file: str, is_folder: bool
) -> None:
    folder = write_bag(tmp_path, kind, small())
    body, path = (folder / file).read_bytes(), folder if is_folder else folder / file
    for length in (len(body) // 2, 0):
        (folder / file).write_bytes(body[:length])
        is_named = length == 0 and not is_folder
        reject(path, "is empty" if is_named else "cannot be read as a bag of ROS.*Copy it again")


def test_truncated_empty_and_unindexed_bags_of_ros1_are_rejected(tmp_path: Path) -> None:
    path = write_bag(tmp_path, "ros1", small())
    body = path.read_bytes()
    position = body.index(b"index_pos=") + len(b"index_pos=")
    path.write_bytes(body[:position] + bytes(8) + body[position + 8 :])
    reject(path, "not indexed.*rosbag reindex bag.bag")
    for length in (len(body) // 2, 100):
        path.write_bytes(body[:length])
        reject(path, "cannot be read as a bag of ROS.*rosbag reindex")
    path.write_bytes(b"")
    reject(path, "is empty. Copy it again")


@pytest.mark.parametrize("suffix", [".bag", ".mcap", ".db3"])
def test_file_of_another_type_is_rejected_with_its_first_bytes(tmp_path: Path, suffix: str) -> None:
    path = tmp_path / f"photo{suffix}"
    path.write_bytes(b"\xff\xd8\xff\xe0JFIF" * 100)
    reject(path, r"is no bag of ROS: it begins with b'\\xff\\xd8.*Check that it is the right file")


@pytest.mark.parametrize("kind", KINDS)
def test_bag_without_messages_is_rejected(tmp_path: Path, kind: str) -> None:
    reject(write_bag(tmp_path, kind, []), "has no messages")


def test_mcap_without_chunks_is_rejected(tmp_path: Path) -> None:
    from mcap.writer import Writer as McapWriter

    path = tmp_path / "plain.mcap"
    writer = McapWriter(str(path), use_chunking=False)
    writer.start("ros2", "test")
    schema = writer.register_schema("sensor_msgs/msg/Image", "ros2msg", b"")
    channel = writer.register_channel(COLOR, "cdr", schema)
    writer.add_message(channel, 5, cdr(color_message(5)), 5)
    writer.finish()
    reject(path, r"no index of chunks\. Write it again .*`mcap filter plain\.mcap")


def test_bag_of_ros2_that_was_not_closed_is_rejected(tmp_path: Path) -> None:
    folder = write_bag(tmp_path, "sqlite3", small())
    (folder / "metadata.yaml").unlink()
    reject(folder, "metadata.*does not exist.*`ros2 bag reindex bag`")


def test_folder_whose_metadata_are_no_metadata_is_rejected(tmp_path: Path) -> None:
    for text in ("a: 1\n", "[", "", "- x\n"):
        (tmp_path / "metadata.yaml").write_text(text)
        reject(tmp_path, "cannot be read as a bag of ROS")


@pytest.mark.parametrize(
    ("missing", "match"),
    [
        (
            {"depth": ""},
            r"no topic that is known to have depth images.*color/image_raw \(sensor_ms",
        ),
        (
            {"color": ""},
            r"no topic that is known to have color images.*--topic color=/TOPIC",
        ),
        ({"info": ""}, r"no camera info of /camera/color/image_raw.*of this type: none"),
    ],
)
def test_missing_topic_is_named(tmp_path: Path, missing: dict[str, str], match: str) -> None:
    reject(write_bag(tmp_path, "mcap", small(**missing)), match)


def test_topic_with_another_type_is_shown_with_its_type(tmp_path: Path) -> None:
    text = STORE.types["std_msgs/msg/String"]("no image")
    path = write_bag(tmp_path, "ros1", [*small(color=""), (3, COLOR, text)])
    reject(path, r"no topic .* color images.*color/image_raw \(std_msgs/String\)")


def test_streams_of_two_clocks_are_rejected(tmp_path: Path) -> None:
    entries = [*small(depth=""), (9, DEPTH, depth_message(10**12))]
    reject(write_bag(tmp_path, "mcap", entries), "none of the 2 images.*within 20 ms.*one clock")


def test_unknown_distortion_and_encoding_are_rejected(tmp_path: Path) -> None:
    info = replace(info_of(CAMERA), distortion_model="equidistant")
    path = write_bag(tmp_path / "a", "mcap", [*small(info=""), (1, COLOR_INFO, info)])
    reject(path, "color/camera_info in .*: distortion model 'equidistant' is not supported")
    bayer = image("bayer_rggb8", PIXELS[..., 0], header(10**9, FRAME))
    path = write_bag(tmp_path / "b", "mcap", [*small(color=""), (1, COLOR, bayer)])
    reject(path, "first frames of .* cannot be read.*'bayer_rggb8' is not supported")


def test_damaged_message_is_a_frame_error_and_the_others_are_read(tmp_path: Path) -> None:
    entries = small((10**9, 2 * 10**9, 3 * 10**9))
    broken = replace(color_message(2 * 10**9), height=99)
    entries = [
        (t, topic, broken if topic == COLOR and t == 2 * 10**9 + 7 else message)
        for t, topic, message in entries
    ]
    sequence = open_sequence(str(write_bag(tmp_path, "ros1", entries)))
    with pytest.raises(FrameError, match="99 rows"):
        sequence.read(1)
    assert sequence.read(2).index == 2


def test_missing_library_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_bag(tmp_path, "ros1", small())
    monkeypatch.setitem(sys.modules, "rosbags.rosbag1", None)
    with pytest.raises(ConfigError, match=r"needs the extra `bags`\. Install it by .*\[bags\]"):
        open_sequence(str(path))
