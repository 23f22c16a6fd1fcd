"""Camera frames are checked, rectified, and rejected one by one."""

import msgspec
import numpy as np
import pytest

from ldo_service.actors.frame_source import FrameSource
from ldo_service.datasets import Sequence
from ldo_service.geometry import codecs
from ldo_service.schemas import CameraRgbd, Image
from ldo_service.wire import camera_rgbd_message


@pytest.fixture
def message(room: Sequence) -> CameraRgbd:
    return camera_rgbd_message(room.read(3))


def test_a_frame_comes_out_in_metres(room: Sequence, message: CameraRgbd) -> None:
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


def test_stamps_that_go_back_are_rejected(message: CameraRgbd) -> None:
    source = FrameSource()
    assert len(list(source.handle(message))) == 1
    assert list(source.handle(message)) == []
    assert source.facts() == {"frames_rejected": 1}


def test_a_broken_image_is_rejected_and_the_stream_goes_on(
    message: CameraRgbd, caplog: pytest.LogCaptureFixture
) -> None:
    source = FrameSource()
    broken = Image(encoding="jpeg", width=320, height=240, data=memoryview(b"not a picture"))
    for offset in range(3):
        bad = msgspec.structs.replace(message, color=broken, stamp_ns=message.stamp_ns + offset)
        assert list(source.handle(bad)) == []
    later = msgspec.structs.replace(message, stamp_ns=message.stamp_ns + 10)
    assert len(list(source.handle(later))) == 1
    assert source.facts() == {"frames_rejected": 3}
    assert len(caplog.records) == 1, "one warning per episode, not one per frame"


def test_an_image_of_another_size_than_announced_is_rejected(
    room: Sequence, message: CameraRgbd
) -> None:
    half = codecs.encode_jpeg(room[3].color[::2, ::2])
    lying = Image(encoding="jpeg", width=320, height=240, data=memoryview(half))
    source = FrameSource()
    assert list(source.handle(msgspec.structs.replace(message, color=lying))) == []
    assert source.facts() == {"frames_rejected": 1}


def test_a_successor_still_knows_the_last_stamp(message: CameraRgbd) -> None:
    first, second = FrameSource(), FrameSource()
    list(first.handle(message))
    second.restore(first.snapshot())
    assert list(second.handle(message)) == []
