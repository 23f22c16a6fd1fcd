"""Conversions between messages and internal types: cameras, frames, keyframes and masks."""

import cv2
import msgspec
import numpy as np

from ldo_service import schemas
from ldo_service.calibration.correction import CameraCorrection
from ldo_service.geometry import Camera, RawFrame, RgbdFrame, codecs
from ldo_service.schemas import (
    Array,
    CameraModel,
    CameraRgbd,
    FrameRgbd,
    Image,
    Keyframe,
    KeyframeMeasurements,
    LabelRequest,
    TrackedPose,
)
from ldo_service.schemas.frames import ImageEncoding
from ldo_service.schemas.keyframe import NO_MASK
from ldo_service.tracking.keyframes import ReferenceKeyframe
from ldo_service.tracking.motion_segmentation import resized
from ldo_service.tracking.pyramid import PyramidConfig, pyramid_of
from ldo_service.tracking.tracking_result import NewKeyframe, TrackingResult

from .poses import (
    matrix6_to_message,
    pose_from_message,
    pose_to_message,
    relative_pose_to_message,
)


def camera_to_message(camera: Camera) -> CameraModel:
    """Return the message of a camera."""
    return CameraModel(
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        distortion=camera.distortion,
    )


def camera_from_message(model: CameraModel) -> Camera:
    """Return the camera of a message."""
    return Camera(
        model.width, model.height, model.fx, model.fy, model.cx, model.cy, model.distortion
    )


def frame_to_message(frame: RgbdFrame) -> FrameRgbd:
    """Convert a rectified frame to its message."""
    return FrameRgbd(
        stamp_ns=frame.stamp_ns,
        frame=frame.index,
        camera=camera_to_message(frame.camera),
        color=Array.of(frame.color),
        depth_m=Array.of(frame.depth_m),
    )


def frame_from_message(message: FrameRgbd | Keyframe) -> RgbdFrame:
    """Convert a message to a rectified frame, whose arrays are read-only views of the message."""
    return RgbdFrame(
        color=message.color.numpy(),
        depth_m=message.depth_m.numpy(),
        camera=camera_from_message(message.camera),
        stamp_ns=message.stamp_ns,
        index=message.frame,
    )


def tracked_pose_message(
    frame: RgbdFrame, result: TrackingResult, T_base_camera: np.ndarray
) -> TrackedPose:
    """Return the message of a tracked frame.

    Args:
        frame: The frame.
        result: Tracking result of the frame.
        T_base_camera: Pose of the camera in the base frame of the robot, [4, 4].
    """
    keyframe = result.keyframe
    return TrackedPose(
        stamp_ns=frame.stamp_ns,
        frame=frame.index,
        status=result.status.value,
        T_odom_camera=pose_to_message(result.T_odom_camera),
        T_map_odom=pose_to_message(result.T_map_odom),
        graph_version=result.graph_version,
        reference=result.reference,
        T_reference_camera=pose_to_message(result.T_reference_camera),
        keyframe=None if keyframe is None else keyframe.id,
        covariance=matrix6_to_message(np.linalg.pinv(result.information, hermitian=True)),
        inlier_fraction=result.inlier_fraction,
        residual_color=result.intensity_sigma,
        residual_depth=result.depth_noise_scale,
        overlap=result.overlap,
        iterations=result.iterations,
        pose_source=result.pose_source,
        hypothesis_spread_rad=result.hypothesis_spread_rad,
        T_base_camera=pose_to_message(T_base_camera),
        submap=result.submap,
    )


def keyframe_message(
    frame: RgbdFrame,
    result: TrackingResult,
    keyframe: NewKeyframe,
    correction: CameraCorrection | None = None,
) -> Keyframe:
    """Return the message of a keyframe.

    Args:
        frame: The frame of the keyframe, corrected by `correction`.
        result: Tracking result of the frame.
        keyframe: Keyframe that the tracker made of the frame.
        correction: Correction of the camera that was applied to the frame; None if there was none.
    """
    used = CameraCorrection() if correction is None else correction
    merge = keyframe.submap_measurement
    return Keyframe(
        stamp_ns=frame.stamp_ns,
        keyframe=keyframe.id,
        frame=frame.index,
        camera=camera_to_message(frame.camera),
        color=Array.of(frame.color),
        depth_m=Array.of(frame.depth_m),
        reference=None if result.reference == keyframe.id else result.reference,
        T_reference_keyframe=pose_to_message(result.T_reference_camera),
        information=matrix6_to_message(result.information),
        T_odom_keyframe=pose_to_message(result.T_odom_camera),
        overlap=result.overlap,
        window_measurements=tuple(map(relative_pose_to_message, keyframe.window)),
        dynamic_mask=mask_to_array(result.dynamic_mask, frame.camera),
        submap=keyframe.submap,
        submap_measurements=() if merge is None else (relative_pose_to_message(merge),),
        camera_correction=camera_correction_to_message(used),
    )


def camera_correction_to_message(correction: CameraCorrection) -> schemas.CameraCorrection:
    """Convert a correction of the camera to its message."""
    return msgspec.convert(correction.pack(), schemas.CameraCorrection)


def camera_correction_from_message(message: schemas.CameraCorrection) -> CameraCorrection:
    """Return the correction of the camera of a message."""
    return CameraCorrection.of(msgspec.to_builtins(message))


def keyframe_measurements_message(keyframe: Keyframe) -> KeyframeMeasurements:
    """Return the message with the measurements of a keyframe, without its images."""
    fields = KeyframeMeasurements.__struct_fields__
    return KeyframeMeasurements(**{name: getattr(keyframe, name) for name in fields})


def keyframe_from_message(message: Keyframe, config: PyramidConfig) -> ReferenceKeyframe:
    """Convert a message to a keyframe that frames can be aligned to.

    Args:
        message: The message; the pixels of its dynamic mask are excluded from alignment.
        config: Settings of the image pyramid.
    """
    view = pyramid_of(frame_from_message(message), config)
    return ReferenceKeyframe(
        view,
        pose_from_message(message.T_odom_keyframe),
        message.keyframe,
        message.submap,
        ignore_mask=resized(mask_from_array(message.dynamic_mask), view.levels[0].depth_m.shape),
    )


def mask_to_array(mask: np.ndarray | None, camera: Camera) -> Array:
    """Convert a mask [h, w] bool to a message array, resized to the image size of a camera.

    Returns:
        [H, W] u1, or the empty array `NO_MASK` if no pixel is set.
    """
    if mask is None or not mask.any():
        return NO_MASK
    size = camera.width, camera.height
    return Array.of(cv2.resize(mask.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST))


def mask_from_array(array: Array) -> np.ndarray | None:
    """Return the mask [H, W] bool of an array, or None if the array is empty."""
    return array.numpy() > 0 if array.data.nbytes else None


def crops_from_request(request: LabelRequest) -> list[np.ndarray]:
    """Return the decoded crops of a label request, [h, w, 3] uint8 RGB each.

    Raises:
        FrameError: The data of a crop do not match its stated encoding and size.
    """
    return [codecs.decode_color(c.encoding, c.width, c.height, c.data) for c in request.crops]


def raw_frame_to_message(raw: RawFrame, compress_depth: bool = True) -> CameraRgbd:
    """Convert a raw frame of the camera to its message.

    Color stays uncompressed. Depth is compressed by zstd unless `compress_depth` is False.
    """
    height, width = raw.depth.shape
    depth = np.asarray(raw.depth, np.float32) if raw.depth.dtype == np.float64 else raw.depth
    encoding: ImageEncoding = "z16" if depth.dtype == np.uint16 else "f32"
    data = depth.tobytes()
    if compress_depth:
        encoding, data = codecs.encode_depth(depth)
    return CameraRgbd(
        stamp_ns=raw.stamp_ns,
        frame=raw.index,
        camera=camera_to_message(raw.camera),
        color=Image(
            encoding="rgb8", width=width, height=height, data=memoryview(raw.color.tobytes())
        ),
        depth=Image(encoding=encoding, width=width, height=height, data=memoryview(data)),
        depth_scale=raw.depth_scale,
    )


def raw_frame_from_message(message: CameraRgbd, index: int) -> RawFrame:
    """Convert a message to a raw frame of the camera, with decompressed images.

    Args:
        message: The message.
        index: Number of the frame.

    Raises:
        DataError: An image or the camera of the message is invalid.
    """
    color, depth = message.color, message.depth
    return RawFrame(
        index=index,
        stamp_ns=message.stamp_ns,
        color=codecs.decode_color(color.encoding, color.width, color.height, color.data),
        depth=codecs.decode_depth(depth.encoding, depth.width, depth.height, depth.data),
        depth_scale=message.depth_scale,
        camera=camera_from_message(message.camera),
    )
