"""Odometry of other libraries behind one interface, at documented defaults, on one thread.

A peer is a `Step`: it takes the next frame and returns T_world_camera, and True if it reports the
frame as tracked. If a peer returns no pose, or one more than 1 m from the previous one, the pose
stays the same; otherwise some diverge to infinity.
"""

from collections.abc import Callable, Iterator
from types import ModuleType
from typing import Any, TypeVar

import cv2
import numpy as np
import small_gicp

from ldo_service.geometry import Camera, RgbdFrame, se3

Step = Callable[[RgbdFrame], tuple[np.ndarray, bool]]
T = TypeVar("T")  # Prepared frame.
Found = tuple[np.ndarray, bool]  # T_previous_current, and True if it was found.

# small_gicp's defaults are for a lidar in a street: points 0.25 m apart, voxels of 1 m,
# correspondences within 1 m. A room is about 5 times smaller than a street.
STREET, ROOM = 1.0, 0.2
FARTHEST_M = 1.0  # Maximum motion between two frames.
SPACING_M, VOXEL_M, REACH_M = 0.25, 1.0, 1.0

OPEN3D_VOXEL_M, OPEN3D_BLOCKS = 3.0 / 512, 40_000  # Values of the dense SLAM example.
OPEN3D_DEPTH_MAX_M = 3.0  # Default of Open3D.
DEPTH_SCALE = 1000.0


def peers(camera: Camera) -> Iterator[tuple[str, Step]]:
    """Yield names and steps of the installed peers, and print which are missing."""
    if hasattr(cv2, "Odometry"):
        yield "OpenCV RGB-D, frame to frame", opencv(camera)
    else:
        print(f"OpenCV is skipped: version {cv2.__version__} has no cv2.Odometry.")
    for scale, name in ((STREET, "defaults"), (ROOM, "a fifth of them")):
        yield f"small_gicp, frame to frame, {name}", gicp_frames(camera, scale)
        yield f"small_gicp, voxel map, {name}", gicp_voxels(camera, scale)
    try:
        import open3d  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        print(f"Open3D is skipped ({error}); install it with: pip install --group bench.")
        return
    yield "Open3D hybrid, frame to frame", open3d_frames(open3d, camera)
    yield "Open3D hybrid tensor, frame to frame", open3d_tensors(open3d, camera)
    yield "Open3D dense SLAM, frame to model", open3d_model(open3d, camera)


def frame_to_frame(prepare: Callable[[RgbdFrame], T], align: Callable[[T, T], Found]) -> Step:
    """Return a step that chains the poses of `align(previous, current)`."""
    previous: list[T] = []
    T_world_camera = np.eye(4)

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        nonlocal T_world_camera
        current = prepare(frame)
        found = True
        if previous:
            T_previous_current, found = align(previous.pop(), current)
            if is_possible(T_previous_current):
                T_world_camera = T_world_camera @ T_previous_current
        previous.append(current)
        return T_world_camera, found

    return step


def is_possible(T_previous_current: np.ndarray) -> bool:
    return bool(np.linalg.norm(T_previous_current[:3, 3]) < FARTHEST_M)  # False for NaN.


# --- OpenCV ---------------------------------------------------------------------------------------
def opencv(camera: Camera) -> Step:
    """Return cv2.Odometry with color and depth."""
    settings = cv2.OdometrySettings()
    settings.setCameraMatrix(camera.matrix.astype(np.float32))
    odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)

    def prepare(frame: RgbdFrame) -> cv2.OdometryFrame:
        depth_m = np.where(frame.depth_m > 0, frame.depth_m, np.nan)
        prepared = cv2.OdometryFrame(depth_m, cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        odometry.prepareFrame(prepared)
        return prepared

    def align(previous: cv2.OdometryFrame, current: cv2.OdometryFrame) -> Found:
        found, T_previous_current = odometry.compute(current, previous)
        return T_previous_current if found else np.eye(4), bool(found)

    return frame_to_frame(prepare, align)


# --- small_gicp -----------------------------------------------------------------------------------
def gicp_frames(camera: Camera, scale: float) -> Step:
    """Return GICP that starts at the previous motion, as in the scan-to-scan example."""
    T_previous_current = np.eye(4)

    def align(previous: tuple, current: tuple) -> Found:
        nonlocal T_previous_current
        found = small_gicp.align(
            previous[0],
            current[0],
            previous[1],
            init_T_target_source=T_previous_current,
            max_correspondence_distance=scale * REACH_M,
        )
        is_sane = is_possible(found.T_target_source)
        T_previous_current = found.T_target_source if is_sane else np.eye(4)
        return T_previous_current, found.converged and is_sane

    return frame_to_frame(lambda frame: _sampled(camera, frame, scale), align)


def gicp_voxels(camera: Camera, scale: float) -> Step:
    """Return GICP against a voxel map of the last 100 frames, as in the scan-to-model example."""
    voxels = small_gicp.GaussianVoxelMap(scale * VOXEL_M)
    voxels.set_lru(horizon=100, clear_cycle=10)
    T_world_camera, T_motion = np.eye(4), np.eye(4)

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        nonlocal T_world_camera, T_motion
        cloud, _ = _sampled(camera, frame, scale)
        is_found = True
        if voxels.size():
            guess, reach_m = T_world_camera @ T_motion, scale * REACH_M
            found = small_gicp.align(voxels, cloud, guess, max_correspondence_distance=reach_m)
            # Rounding errors would accumulate over the initial guesses.
            T_motion = se3.orthonormalize(se3.inverse(T_world_camera) @ found.T_target_source)
            is_sane = is_possible(T_motion)
            is_found, T_motion = found.converged and is_sane, T_motion if is_sane else np.eye(4)
            T_world_camera = se3.orthonormalize(T_world_camera @ T_motion)
        voxels.insert(cloud, T_world_camera)
        return T_world_camera, is_found

    return step


def _sampled(camera: Camera, frame: RgbdFrame, scale: float) -> tuple:
    """Return the point cloud with covariances, and its tree."""
    seen = frame.depth_m > 0
    points = (camera.rays() * frame.depth_m[..., None])[seen]
    return small_gicp.preprocess_points(points, scale * SPACING_M)


# --- Open3D ---------------------------------------------------------------------------------------
def open3d_frames(o3d: ModuleType, camera: Camera) -> Step:
    """Return the RGB-D odometry of the tutorial, with the hybrid term and depth up to 3 m."""
    size = camera.width, camera.height
    pinhole = o3d.camera.PinholeCameraIntrinsic(*size, camera.fx, camera.fy, camera.cx, camera.cy)
    odometry = o3d.pipelines.odometry
    term = odometry.RGBDOdometryJacobianFromHybridTerm()

    def prepare(frame: RgbdFrame) -> object:
        color, depth = o3d.geometry.Image(frame.color), o3d.geometry.Image(_millimeters(frame))
        return o3d.geometry.RGBDImage.create_from_color_and_depth(color, depth)

    def align(previous: object, current: object) -> Found:
        found = odometry.compute_rgbd_odometry(current, previous, pinhole, np.eye(4), term)
        return found[1] if found[0] else np.eye(4), found[0]

    return frame_to_frame(prepare, align)


def open3d_tensors(o3d: ModuleType, camera: Camera) -> Step:
    """Return the newer multi-scale RGB-D odometry, which uses the hybrid method by default."""
    matrix, odometry = o3d.core.Tensor(camera.matrix), o3d.t.pipelines.odometry

    def prepare(frame: RgbdFrame) -> object:
        images = (o3d.t.geometry.Image(image) for image in (frame.color, _millimeters(frame)))
        return o3d.t.geometry.RGBDImage(*images)

    def align(previous: object, current: object) -> Found:
        return _tracked(lambda: odometry.rgbd_odometry_multi_scale(current, previous, matrix))

    return frame_to_frame(prepare, align)


def open3d_model(o3d: ModuleType, camera: Camera) -> Step:
    """Return the dense SLAM example: depth against a ray cast of the fused volume."""
    slam, device = o3d.t.pipelines.slam, o3d.core.Device("CPU:0")
    T_world_camera, count = np.eye(4), 0
    start, shape = o3d.core.Tensor(T_world_camera), (camera.height, camera.width)
    model = slam.Model(OPEN3D_VOXEL_M, 16, OPEN3D_BLOCKS, start, device)
    matrix = o3d.core.Tensor(camera.matrix)
    given, cast = (slam.Frame(*shape, matrix, device) for _ in range(2))

    def step(frame: RgbdFrame) -> tuple[np.ndarray, bool]:
        nonlocal T_world_camera, count
        given.set_data_from_image("depth", o3d.t.geometry.Image(_millimeters(frame)))
        given.set_data_from_image("color", o3d.t.geometry.Image(frame.color))
        found = True
        if count:
            T_cast_given, found = _tracked(lambda: model.track_frame_to_model(given, cast))
            if is_possible(T_cast_given):
                T_world_camera = T_world_camera @ T_cast_given
        model.update_frame_pose(count, o3d.core.Tensor(T_world_camera))
        model.integrate(given)
        model.synthesize_model_frame(cast)
        count += 1
        return T_world_camera, found

    return step


def _tracked(align: Callable[[], Any]) -> Found:
    """Return the result of Open3D's tensor odometry, which raises if its system is singular."""
    try:
        found = align()
    except RuntimeError:
        return np.eye(4), False
    T_target_source = found.transformation.cpu().numpy()
    return T_target_source, found.fitness > 0


def _millimeters(frame: RgbdFrame) -> np.ndarray:
    return np.round(DEPTH_SCALE * frame.depth_m).astype(np.uint16)
