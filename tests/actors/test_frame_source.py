"""Checks, pairing and rejection of camera frames."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from ldo_service.actors.frame_source import FrameSource, FrameSourceConfig
from ldo_service.config import Config
from ldo_service.conversions.frames import camera_to_message, raw_frame_to_message
from ldo_service.conversions.poses import pose_to_message
from ldo_service.datasets import Sequence
from ldo_service.errors import ConfigError
from ldo_service.geometry import Camera, RgbdFrame, codecs, se3
from ldo_service.schemas import (
    CameraColor,
    CameraDepth,
    CameraModel,
    CameraRgbd,
    FrameRgbd,
    Image,
    Message,
    decode,
    encode,
)


@pytest.fixture
def message(room: Sequence) -> CameraRgbd:
    return raw_frame_to_message(room.read(3))


def test_a_frame_comes_out_in_meters(room: Sequence, message: CameraRgbd) -> None:
    (frame,) = FrameSource().handle(message)
    np.testing.assert_array_equal(frame.color.numpy(), room[3].color)
    np.testing.assert_array_equal(frame.depth_m.numpy(), room[3].depth_m)
    assert (frame.frame, frame.stamp_ns) == (message.frame, message.stamp_ns)


def test_integer_depth_is_divided_by_its_scale(room: Sequence, message: CameraRgbd) -> None:
    depth_mm = np.round(room[3].depth_m * 1000).astype(np.uint16)
    sent = msgspec.structs.replace(message, depth=Image.raw("z16", depth_mm), depth_scale=1000.0)
    (frame,) = FrameSource().handle(sent)
    np.testing.assert_allclose(frame.depth_m.numpy(), room[3].depth_m, atol=6e-4)


def test_nan_depth_means_not_measured(room: Sequence, message: CameraRgbd) -> None:
    depth = room[3].depth_m.copy()
    depth[:20] = np.nan
    (frame,) = FrameSource().handle(msgspec.structs.replace(message, depth=Image.raw("f32", depth)))
    assert (frame.depth_m.numpy()[:20] == 0).all()
    np.testing.assert_array_equal(frame.depth_m.numpy()[20:], depth[20:])


def test_stamps_that_go_back_are_rejected(
    message: CameraRgbd, caplog: pytest.LogCaptureFixture
) -> None:
    source = FrameSource()
    assert len(list(source.handle(message))) == 1
    assert list(source.handle(message)) == []
    assert source.metrics()["frames_rejected"] == 1
    assert caplog.records[0].message.endswith("use `ldo publish SOURCE --restamp`.")


def test_a_broken_image_is_rejected_and_the_stream_continues(
    message: CameraRgbd, caplog: pytest.LogCaptureFixture
) -> None:
    source = FrameSource()
    broken = Image(encoding="jpeg", width=320, height=240, data=memoryview(b"not a picture"))
    for offset in range(3):
        bad = msgspec.structs.replace(message, color=broken, stamp_ns=message.stamp_ns + offset)
        assert list(source.handle(bad)) == []
    later = msgspec.structs.replace(message, stamp_ns=message.stamp_ns + 10)
    assert len(list(source.handle(later))) == 1
    assert source.metrics()["frames_rejected"] == 3
    assert len(caplog.records) == 1, "one warning per episode, not one per frame"


def test_an_image_of_another_size_than_announced_is_rejected(
    room: Sequence, message: CameraRgbd
) -> None:
    half = codecs.encode_jpeg(room[3].color[::2, ::2])
    mismatched = Image(encoding="jpeg", width=320, height=240, data=memoryview(half))
    source = FrameSource()
    assert list(source.handle(msgspec.structs.replace(message, color=mismatched))) == []
    assert source.metrics()["frames_rejected"] == 1


def test_restored_frame_source_rejects_old_stamps(message: CameraRgbd) -> None:
    first, second = FrameSource(), FrameSource()
    list(first.handle(message))
    second.restore(first.snapshot())
    assert list(second.handle(message)) == []


# --- color and depth on two topics ----------------------------------------------------------------
def color_image(frame: RgbdFrame, stamp_ns: int | None = None) -> CameraColor:
    return CameraColor(
        stamp_ns=frame.stamp_ns if stamp_ns is None else stamp_ns,
        frame=frame.index,
        camera=camera_to_message(frame.camera),
        image=Image.raw("rgb8", frame.color),
    )


def depth_image(
    frame: RgbdFrame, stamp_ns: int | None = None, T_color_depth: np.ndarray | None = None
) -> CameraDepth:
    return CameraDepth(
        stamp_ns=frame.stamp_ns if stamp_ns is None else stamp_ns,
        frame=frame.index + 1000,
        camera=camera_to_message(frame.camera),
        image=Image.raw("f32", frame.depth_m),
        depth_scale=1.0,
        T_color_depth=pose_to_message(np.eye(4) if T_color_depth is None else T_color_depth),
    )


def frames_of(source: FrameSource, *messages: Message) -> list[FrameRgbd]:
    return [frame for message in messages for frame in source.handle(message)]


def coarser(frame: RgbdFrame) -> RgbdFrame:
    """Return every second pixel of a frame, exactly."""
    k = frame.camera
    camera = Camera(k.width // 2, k.height // 2, k.fx / 2, k.fy / 2, k.cx / 2, k.cy / 2)
    color, depth_m = (np.ascontiguousarray(a[::2, ::2]) for a in (frame.color, frame.depth_m))
    return RgbdFrame(color, depth_m, camera, frame.stamp_ns, frame.index)


def test_color_and_depth_images_give_the_same_frame_as_an_rgbd_message(room: Sequence) -> None:
    whole = frames_of(FrameSource(), raw_frame_to_message(room.read(3)))
    color, depth = color_image(room[3]), depth_image(room[3])
    assert frames_of(FrameSource(), color, depth) == whole
    assert frames_of(FrameSource(), depth, color) == whole, "in either order"


def test_pair_has_stamp_and_number_of_its_color_image(room: Sequence) -> None:
    color = color_image(room[3], stamp_ns=50_000_000)
    depth = depth_image(room[3], stamp_ns=57_000_000)
    source = FrameSource()
    (frame,) = frames_of(source, color, depth)
    assert (frame.stamp_ns, frame.frame) == (50_000_000, 3)
    metrics = source.metrics()
    assert (metrics["pairs"], metrics["skew_ms_p50"], metrics["skew_ms_max"]) == (1, 7.0, 7.0)


def test_images_beyond_max_skew_are_dropped_and_counted(room: Sequence) -> None:
    source = FrameSource(FrameSourceConfig(max_skew_s=0.005))
    images = [
        image
        for i in range(5)
        for image in (
            color_image(room[i], stamp_ns=i * 33_000_000),
            depth_image(room[i], stamp_ns=i * 33_000_000 + 10_000_000),
        )
    ]
    assert frames_of(source, *images) == []
    metrics = source.metrics()
    assert (metrics["pairs"], metrics["color_unpaired"], metrics["depth_unpaired"]) == (0, 5, 4)


def test_stamps_of_two_clocks_are_logged_once(
    room: Sequence, caplog: pytest.LogCaptureFixture
) -> None:
    source = FrameSource()
    for i in range(100):
        frames_of(source, color_image(room[0], i * 33_000_000))
        frames_of(source, depth_image(room[0], 10**18 + i * 33_000_000))
    assert [r for r in caplog.records if "one clock" in r.message] == caplog.records
    assert len(caplog.records) == 1


def test_coarser_depth_is_resampled_to_the_color_image(room: Sequence) -> None:
    color, depth = color_image(room[3]), depth_image(coarser(room[3]))
    (frame,) = frames_of(FrameSource(), color, depth)
    assert frame.camera == color.camera
    error = np.abs(frame.depth_m.numpy() - room[3].depth_m)
    assert np.median(error) < 0.01
    assert (frame.depth_m.numpy() > 0).mean() > 0.98


def test_depth_of_a_separate_camera_is_transformed_by_its_extrinsics(room: Sequence) -> None:
    """The depth image is from a later pose, which is exactly known relative to the color image."""
    truth = room.truth()
    assert truth is not None
    color_index, depth_index = 3, 9
    T_color_depth = (
        se3.inverse(truth.T_world_camera[color_index]) @ truth.T_world_camera[depth_index]
    )
    assert np.linalg.norm(T_color_depth[:3, 3]) > 0.02, "a baseline as large as a camera's"
    color = color_image(room[color_index])
    transformed, untransformed = (
        frames_of(FrameSource(), color, depth_image(room[depth_index], color.stamp_ns, T))[0]
        for T in (T_color_depth, np.eye(4))
    )
    assert _median_error(transformed, room[color_index]) < 0.003
    assert _median_error(untransformed, room[color_index]) > 0.01


def _median_error(frame: FrameRgbd, truth: RgbdFrame) -> float:
    depth_m = frame.depth_m.numpy()
    seen = (depth_m > 0) & (truth.depth_m > 0)
    assert seen.mean() > 0.8
    return float(np.median(np.abs(depth_m - truth.depth_m)[seen]))


def test_same_color_and_depth_images_give_bitwise_equal_frames(room: Sequence) -> None:
    images = [
        image for i in range(4) for image in (color_image(room[i]), depth_image(coarser(room[i])))
    ]
    first, second = (
        [encode(frame) for frame in frames_of(FrameSource(), *images)] for _ in range(2)
    )
    assert len(first) == 4
    assert first == second


def test_color_and_depth_stamps_that_go_back_are_rejected(room: Sequence) -> None:
    source = FrameSource()
    assert len(frames_of(source, color_image(room[3]), depth_image(room[3]))) == 1
    assert frames_of(source, color_image(room[2]), depth_image(room[2])) == []
    assert source.metrics()["frames_rejected"] == 2
    assert len(frames_of(source, color_image(room[4]), depth_image(room[4]))) == 1


def test_an_image_too_small_to_track_is_rejected() -> None:
    camera = CameraModel(width=8, height=6, fx=6, fy=6, cx=3.5, cy=2.5)
    tiny = CameraRgbd(
        stamp_ns=1,
        frame=0,
        camera=camera,
        color=Image.raw("rgb8", np.zeros((6, 8, 3), np.uint8)),
        depth=Image.raw("f32", np.ones((6, 8), np.float32)),
        depth_scale=1.0,
    )
    source = FrameSource()
    assert frames_of(source, tiny) == []
    assert source.metrics()["frames_rejected"] == 1


@pytest.mark.parametrize(
    "fields", [{"max_skew_s": -0.1}, {"max_skew_s": 60.0}, {"pair_buffer": 0}, {"min_side_px": 0}]
)
def test_impossible_settings_are_refused(fields: dict[str, float]) -> None:
    with pytest.raises(ConfigError):
        FrameSourceConfig(**fields)  # type: ignore[arg-type]


def test_restarted_camera_begins_a_new_session(room: Sequence) -> None:
    """Stamps repeat, as when a recording is published twice."""
    source = FrameSource()
    messages = [raw_frame_to_message(room.read(i)) for i in range(0, 60, 20)]
    for _ in range(2):
        assert len([out for message in messages for out in source.handle(message)]) == 3
    assert source.metrics()["camera_sessions"] == 2
    assert source.metrics()["frames_rejected"] == 0


def test_one_stamp_in_the_far_future_does_not_block_later_frames(room: Sequence) -> None:
    source = FrameSource()
    message = raw_frame_to_message(room.read(0))
    future = msgspec.structs.replace(message, stamp_ns=10**18)
    frames = [message, future, raw_frame_to_message(room.read(1))]
    assert len([out for frame in frames for out in source.handle(frame)]) == 3


def test_documented_largest_image_is_the_one_that_the_tracker_can_receive(
    room: Sequence, message: CameraRgbd
) -> None:
    (frame,) = FrameSource().handle(message)
    pixels = room[3].depth_m.size
    bytes_per_pixel = len(encode(frame)) // pixels  # The rest, the header, is below one per pixel.
    limit_mb = Config().service.max_decoded_message_mb
    limits = (Path(__file__).parents[2] / "docs" / "limits.md").read_text()
    assert f"| an image | {limit_mb / bytes_per_pixel:.1f} megapixels with the default" in limits
    assert f"a frame takes {bytes_per_pixel} bytes per pixel" in limits


@pytest.mark.parametrize("far", [1000.0, 1e30, float(np.finfo(np.float32).max)])
def test_depth_beyond_any_camera_counts_as_not_measured(
    room: Sequence, message: CameraRgbd, far: float
) -> None:
    depth_m = room[3].depth_m.copy()
    depth_m[:10] = far
    sent = msgspec.structs.replace(message, depth=Image.raw("f32", depth_m), depth_scale=1.0)
    source = FrameSource()
    (frame,) = source.handle(sent)
    assert not frame.depth_m.numpy()[:10].any()
    np.testing.assert_array_equal(frame.depth_m.numpy()[10:], depth_m[10:])
    assert source.metrics()["pixels_too_far"] == depth_m[:10].size


@pytest.mark.parametrize("near", [1e-45, 1e-36, 0.0009])
def test_depth_below_a_millimeter_counts_as_not_measured(
    room: Sequence, message: CameraRgbd, near: float
) -> None:
    depth_m = room[3].depth_m.copy()
    depth_m[:10], depth_m[10:20] = near, 0.001
    sent = msgspec.structs.replace(message, depth=Image.raw("f32", depth_m), depth_scale=1.0)
    (frame,) = FrameSource().handle(sent)
    assert not frame.depth_m.numpy()[:10].any()
    np.testing.assert_array_equal(frame.depth_m.numpy()[10:], depth_m[10:])


def test_cameras_that_do_not_belong_together_are_rejected_at_once() -> None:
    width, height = 640, 480
    lens = (1e9, 0.0, 0.0, 0.0, 0.0, 1e12, 0.0, 0.0)
    of_color = CameraModel(
        width=width, height=height, fx=100.0 * width, fy=100.0 * height, cx=320.0, cy=240.0,
        distortion=lens,
    )  # fmt: skip
    of_depth = CameraModel(width=width, height=height, fx=100.0, fy=75.0, cx=320.0, cy=240.0)
    source = FrameSource()
    color = Image.raw("rgb8", np.zeros((height, width, 3), np.uint8))
    depth = Image.raw("z16", np.full((height, width), 1000, np.uint16))
    halves = (
        CameraColor(stamp_ns=1, frame=0, camera=of_color, image=color),
        CameraDepth(stamp_ns=1, frame=0, camera=of_depth, image=depth, depth_scale=1000.0),
    )
    assert [frame for half in halves for frame in source.handle(half)] == []
    assert source.metrics()["frames_rejected"] == 1


def test_unpaired_images_are_bounded_by_bytes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ldo_service.actors.frame_source.PAIR_BUFFER_BYTES", 50_000)
    source = FrameSource()
    camera = CameraModel(width=100, height=50, fx=100.0, fy=100.0, cx=50.0, cy=25.0)
    image = Image.raw("rgb8", np.zeros((50, 100, 3), np.uint8))  # 15,000 bytes.
    for number in range(8):
        stamp_ns = number * 10**9
        list(source.handle(CameraColor(stamp_ns=stamp_ns, frame=0, camera=camera, image=image)))
    assert source.metrics()["color_unpaired"] == 5


def test_unknown_fields_count_for_the_size_of_unpaired_images(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("ldo_service.actors.frame_source.PAIR_BUFFER_BYTES", 50_000)
    source = FrameSource()
    camera = CameraModel(width=100, height=50, fx=100.0, fy=100.0, cx=50.0, cy=25.0)
    image = Image(encoding="png", width=100, height=50, data=memoryview(b"x"))
    for number in range(8):
        half = CameraColor(stamp_ns=number * 10**9, frame=0, camera=camera, image=image)
        fields = msgspec.msgpack.decode(encode(half)) | {"unknown": bytes(15_000)}
        list(source.handle(decode(msgspec.msgpack.encode(fields), CameraColor)))
    assert source.metrics()["color_unpaired"] == 5


def test_two_clocks_in_turn_do_not_fill_the_log(
    message: CameraRgbd, caplog: pytest.LogCaptureFixture
) -> None:
    source = FrameSource()
    for number in range(100):
        stamp_ns = 10**10 * (1 + number % 2) + number
        list(source.handle(msgspec.structs.replace(message, stamp_ns=stamp_ns)))
    assert sum("went back" in record.message for record in caplog.records) < 10
    assert source.metrics()["camera_sessions"] == 50
