"""Writers of frames in the formats of phones and scanners, by their published descriptions."""

import json
import struct
import zipfile
import zlib
from collections.abc import Iterable, Sequence
from pathlib import Path

import av
import cv2
import liblzfse
import numpy as np

from ldo_service.geometry import Camera, RawFrame, se3

DEPTH_SIZE = 256, 192  # Width and height of the depth of an iPhone.


def small_frames(count: int, width: int = 64, height: int = 48) -> list[RawFrame]:
    """Return frames at 30 Hz with a gray that grows with the index, and a tilted plane as depth."""
    camera = Camera(width, height, 0.8 * width, 0.8 * width, width / 2 - 0.5, height / 2 - 0.5)
    slope = np.linspace(1000, 1200, width)[None].repeat(height, 0)
    return [
        RawFrame(
            k,
            10**9 + k * 10**9 // 30 // 1000 * 1000,
            np.full((height, width, 3), 20 + 10 * k, np.uint8),
            (slope + 100 * k).astype(np.uint16),
            1000.0,
            camera,
        )
        for k in range(count)
    ]


def millimeters(frame: RawFrame, size: tuple[int, int]) -> np.ndarray:
    """Return the depth [Hd, Wd] uint16 of a frame, sampled at the centers of larger pixels."""
    depth = np.round(frame.depth_m() * 1000).astype(np.uint16)
    rows, columns = (
        ((np.arange(n) + 0.5) * whole / n).astype(int)
        for n, whole in zip(size[::-1], depth.shape, strict=True)
    )
    return depth[np.ix_(rows, columns)]


def write_image(path: Path, image: np.ndarray) -> None:
    """Write an image, RGB or gray."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), image[..., ::-1] if image.ndim == 3 else image)


def write_video(path: Path, images: Sequence[np.ndarray], gop: int = 30, crf: int = 18) -> None:
    """Write an H.264 video with frames that refer to later ones."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=30)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        stream.options = {"crf": str(crf), "g": str(gop), "bf": "2", "threads": "1"}
        for image in images:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")))
        container.mux(stream.encode(None))


def write_stray(
    folder: Path,
    frames: list[RawFrame],
    depth_size: tuple[int, int] = DEPTH_SIZE,
    enlarged: int = 1,
    gop: int = 30,
    T_world_camera: np.ndarray | None = None,
) -> Path:
    """Write a folder of Stray Scanner; color is `enlarged` times as wide as in the frames."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1)) if T_world_camera is None else T_world_camera
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, frame in enumerate(frames):
        depth = millimeters(frame, depth_size)
        write_image(folder / f"depth/{k:06d}.png", depth)
        write_image(folder / f"confidence/{k:06d}.png", np.where(depth > 0, 2, 0).astype(np.uint8))
        w, *imaginary = se3.quaternion(poses[k][:3, :3])
        numbers = ", ".join(map(str, (*poses[k][:3, 3], *imaginary, w)))
        lines.append(f"{frame.stamp_ns / 1e9:.6f}, {k:06d}, {numbers}")
    (folder / "odometry.csv").write_text("\n".join(lines) + "\n")
    images = [np.repeat(np.repeat(f.color, enlarged, 0), enlarged, 1) for f in frames]
    write_video(folder / "rgb.mp4", images, gop)
    K = enlarged_matrix(frames[0].camera, enlarged)
    rows = [",".join(map(str, row)) for row in K.tolist()]
    (folder / "camera_matrix.csv").write_text("\n".join(rows) + "\n")
    return folder


def enlarged_matrix(camera: Camera, factor: int) -> np.ndarray:
    """Return K [3, 3] of an image whose pixels are blocks of `factor` times `factor` pixels."""
    K = camera.matrix * factor
    K[:2, 2] = (np.array([camera.cx, camera.cy]) + 0.5) * factor - 0.5
    K[2, 2] = 1
    return K


OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # Axes of OpenGL's camera, in those of this project.


def record3d_poses(T_world_camera: np.ndarray) -> list[list[float]]:
    """Return poses [N, 4, 4] as Record3D writes them: qx, qy, qz, qw, x, y, z, axes of OpenGL."""
    poses = []
    for T in T_world_camera @ OPENGL:
        w, *imaginary = se3.quaternion(T[:3, :3])
        poses.append([*map(float, (*imaginary, w, *T[:3, 3]))])
    return poses


def write_r3d(
    path: Path, frames: list[RawFrame], depth_size: tuple[int, int] | None = None, **changed: object
) -> Path:
    """Write a file of Record3D; `changed` replaces values of the metadata, None removes them."""
    camera, (width, height) = frames[0].camera, depth_size or frames[0].depth.shape[::-1]
    metadata = {
        "w": camera.width,
        "h": camera.height,
        "dw": width,
        "dh": height,
        "fps": 30,
        "K": camera.matrix.T.ravel().tolist(),
        "poses": [[0, 0, 0, 1, 0, 0, 0]] * len(frames),
        "initPose": [0, 0, 0, 1, 0, 0, 0],
        "frameTimestamps": [(f.stamp_ns - frames[0].stamp_ns) / 1e9 for f in frames],
        **changed,
    }
    known = {key: value for key, value in metadata.items() if value is not None}
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("metadata", json.dumps(known))
        for k, frame in enumerate(frames):
            mm = millimeters(frame, (width, height))
            depth_m = np.where(mm > 0, mm / np.float32(1000), np.nan).astype(np.float32)
            confidence = np.where(mm > 0, 2, 0).astype(np.uint8)
            jpeg = cv2.imencode(".jpg", frame.color[..., ::-1], (cv2.IMWRITE_JPEG_QUALITY, 95))[1]
            archive.writestr(f"rgbd/{k}.jpg", jpeg.tobytes())
            archive.writestr(f"rgbd/{k}.depth", liblzfse.compress(depth_m.tobytes()))
            archive.writestr(f"rgbd/{k}.conf", liblzfse.compress(confidence.tobytes()))
    return path


def change_archive(path: Path, changed: dict[str, bytes | None]) -> None:
    """Replace files in a ZIP archive; None removes the file."""
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**files, **changed}.items():
            if content is not None:
                archive.writestr(name, content)


def write_nerfstudio(
    folder: Path,
    frames: list[RawFrame],
    depth_size: tuple[int, int] | None = None,
    T_world_camera: np.ndarray | None = None,
) -> Path:
    """Write a folder of nerfstudio; depth is in the unit of the frames unless it is resampled."""
    poses = np.tile(np.eye(4), (len(frames), 1, 1)) if T_world_camera is None else T_world_camera
    camera = frames[0].camera
    content = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        "depth_unit_scale_factor": 0.001 if depth_size else 1 / frames[0].depth_scale,
        "frames": [
            {
                "file_path": f"images/frame_{k:05d}.png",
                "depth_file_path": f"depth/frame_{k:05d}.png",
                "transform_matrix": (poses[k] @ OPENGL).tolist(),
            }
            for k in range(len(frames))
        ],
    }
    for frame, entry in zip(frames, content["frames"], strict=True):
        write_image(folder / entry["file_path"], frame.color)
        depth = millimeters(frame, depth_size) if depth_size else frame.depth
        write_image(folder / entry["depth_file_path"], depth)
    (folder / "transforms.json").write_text(json.dumps(content))
    return folder


def write_sens(
    path: Path,
    frames: list[RawFrame],
    suffix: str = ".jpg",
    zipped: bool = True,
    T_sensor_depth: np.ndarray | None = None,
) -> Path:
    """Write a file .sens; frame k is at x = k m, and frame 1 has no pose.

    Args:
        path: The file.
        frames: The frames, with depth uint16.
        suffix: Encoding of color: ".jpg", ".png" or "", which is raw.
        zipped: True compresses depth.
        T_sensor_depth: Extrinsics of the depth camera, [4, 4]; None is the identity.
    """
    camera, K = frames[0].camera, np.eye(4, dtype="<f4")
    K[:3, :3] = camera.matrix
    T = np.eye(4) if T_sensor_depth is None else T_sensor_depth
    size = camera.width, camera.height
    with path.open("wb") as file:
        file.write(struct.pack("<IQ", 4, 15) + b"StructureSensor")
        for matrix in (K, np.eye(4), K, T):
            file.write(matrix.astype("<f4").tobytes())
        file.write(struct.pack("<2i", {"": 0, ".png": 1, ".jpg": 2}[suffix], int(zipped)))
        file.write(struct.pack("<4IfQ", *size, *size, frames[0].depth_scale, len(frames)))
        for k, frame in enumerate(frames):
            pose = np.full((4, 4), -np.inf) if k == 1 else np.eye(4)
            pose[0, 3] += k
            bgr = frame.color[..., ::-1]
            color = cv2.imencode(suffix, bgr)[1].tobytes() if suffix else frame.color.tobytes()
            depth = frame.depth.astype("<u2").tobytes()
            depth = zlib.compress(depth) if zipped else depth
            stamp_us = frame.stamp_ns // 1000
            file.write(pose.astype("<f4").tobytes())
            file.write(struct.pack("<4Q", stamp_us, stamp_us, len(color), len(depth)))
            file.write(color + depth)
        file.write(struct.pack("<Q", 0))  # The number of inertial measurements.
    return path


def write_open3d(
    folder: Path, frames: list[RawFrame], name: str = "{:06d}", intrinsics: str = "intrinsic.json"
) -> Path:
    """Write a folder of Open3D; the names of the images are `name`, formatted by their numbers."""
    for k, frame in enumerate(frames):
        write_image(folder / f"color/{name.format(k)}.png", frame.color)
        write_image(
            folder / f"depth/{name.format(k)}.png", millimeters(frame, frame.depth.shape[::-1])
        )
    camera = frames[0].camera
    content = {
        "width": camera.width,
        "height": camera.height,
        "intrinsic_matrix": camera.matrix.T.ravel().tolist(),
    }
    (folder / intrinsics).write_text(json.dumps(content))
    return folder


def write_kitti(
    folder: Path,
    pairs: Iterable[tuple[np.ndarray, np.ndarray]],
    camera: Camera,
    baseline_m: float,
    stamps_ns: np.ndarray,
    T_world_camera: np.ndarray,
    offset_m: float = 0.06,
) -> Path:
    """Write a folder of KITTI: left and right images as cameras 2 and 3.

    Camera 0, whose poses the files contain, is `offset_m` to the right of camera 2.
    """
    for k, (left, right) in enumerate(pairs):
        write_image(folder / f"image_2/{k:06d}.png", left)
        write_image(folder / f"image_3/{k:06d}.png", right)
    lines = []
    for name, x_m in (("P0", 0.0), ("P1", 0.5), ("P2", -offset_m), ("P3", baseline_m - offset_m)):
        P = np.hstack([camera.matrix, camera.matrix @ [[-x_m], [0], [0]]])
        lines.append(f"{name}: " + " ".join(f"{n:.12e}" for n in P.ravel()))
    (folder / "calib.txt").write_text("\n".join(lines) + "\n")
    (folder / "times.txt").write_text("".join(f"{t / 1e9:.9e}\n" for t in stamps_ns))
    T_camera_camera0 = np.eye(4)
    T_camera_camera0[0, 3] = offset_m
    rows = (T_world_camera @ T_camera_camera0)[:, :3].reshape(-1, 12)
    (folder / "poses.txt").write_text(
        "".join(" ".join(f"{n:.12e}" for n in row) + "\n" for row in rows)
    )
    return folder


def write_icl_nuim(
    folder: Path, frames: list[RawFrame], T_world_camera: np.ndarray, first: int = 0
) -> Path:
    """Write a folder of ICL-NUIM with TUM-compatible PNGs; the images count from `first`."""
    numbers = range(first, first + len(frames))
    for k, frame in zip(numbers, frames, strict=True):
        write_image(folder / f"rgb/{k}.png", frame.color)
        depth = np.round(frame.depth_m() * 5000).astype(np.uint16)
        write_image(folder / f"depth/{k}.png", depth)
    lines = [f"{k} depth/{k}.png {k} rgb/{k}.png\n" for k in numbers]
    (folder / "associations.txt").write_text("".join(lines))
    write_freiburg(folder / "livingRoom0.gt.freiburg", numbers, T_world_camera)
    return folder


def write_icl_nuim_rendered(
    folder: Path, frames: list[RawFrame], T_world_camera: np.ndarray
) -> Path:
    """Write a folder of ICL-NUIM with the files of its renderer."""
    for k, frame in enumerate(frames):
        write_image(folder / f"scene_00_{k:04d}.png", frame.color)
        norms = np.linalg.norm(frame.camera.rays(), axis=-1)
        distances = (frame.depth_m() * norms).ravel()
        text = " ".join(f"{distance:.7f}" for distance in distances)
        (folder / f"scene_00_{k:04d}.depth").write_text(text + " ")
    write_freiburg(folder / "livingRoom0.gt.freiburg", range(len(frames)), T_world_camera)
    return folder


def write_freiburg(path: Path, numbers: Iterable[int], T_world_camera: np.ndarray) -> None:
    """Write poses as ICL-NUIM does: in left-handed coordinates, with y up."""
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    lines = []
    for k, T in zip(numbers, mirror @ T_world_camera @ mirror, strict=True):
        w, *imaginary = se3.quaternion(T[:3, :3])
        lines.append(f"{k} " + " ".join(f"{n:.9f}" for n in (*T[:3, 3], *imaginary, w)) + "\n")
    path.write_text("".join(lines))


AZURE_DEPTH_SIZE = 320, 288  # Mode NFOV_2X2BINNED.
T_COLOR_DEPTH = se3.exp(np.array([0.02, -0.01, 0.005, -0.032, -0.002, 0.004]))


def azure_calibration(color: Camera, depth: Camera) -> dict[str, object]:
    """Return the calibration of an Azure Kinect whose images have these cameras."""

    def entry(name: str, camera: Camera, whole: tuple[float, float], corner: np.ndarray) -> object:
        k1, k2, p1, p2, k3, k4, k5, k6 = camera.distortion or (0.0,) * 8
        center = np.array([camera.cx, camera.cy]) + 0.5 + corner
        values = (*center / whole, camera.fx / whole[0], camera.fy / whole[1])
        T = T_COLOR_DEPTH if name == "PV0" else np.eye(4)
        return {
            "Location": f"CALIBRATION_CameraLocation{name}",
            "Intrinsics": {
                "ModelParameterCount": 14,
                "ModelParameters": [*values, k1, k2, k3, k4, k5, k6, 0, 0, p2, p1],
                "ModelType": "CALIBRATION_LensDistortionModelBrownConrady",
            },
            "Rt": {
                "Rotation": T[:3, :3].ravel().tolist(),
                "Translation": T[:3, 3].tolist(),
            },
        }

    whole = color.width * 3 / 4
    rows = np.array([0, (whole - color.height) / 2])
    return {
        "CalibrationInformation": {
            "Cameras": [
                entry("D0", depth, (512, 512), np.array([96, 90])),
                entry("PV0", color, (color.width, whole), rows),
            ]
        }
    }


def write_azure(
    path: Path,
    images: Sequence[tuple[np.ndarray, np.ndarray]],
    calibration: dict[str, object] | None,
    codec: str = "mjpeg",
    pixel_format: str = "yuvj422p",
) -> Path:
    """Write a file of k4arecorder by PyAV: color [H, W, 3] and depth [Hd, Wd] in millimeters.

    PyAV leaves out the FOURCC of depth, thus it is written into the header afterwards.
    """
    with av.open(str(path), "w", options={"allow_raw_vfw": "1"}) as container:
        streams = []
        for name, image in zip(("COLOR", "DEPTH"), images[0], strict=True):
            stream = container.add_stream(codec if name == "COLOR" else "rawvideo", rate=30)
            stream.height, stream.width = image.shape[:2]
            stream.pix_fmt = pixel_format if name == "COLOR" else "gray16be"
            if codec == "mjpeg" and name == "COLOR":
                stream.options = {"qmin": "1", "qmax": "2"}
            stream.metadata["title"] = name
            streams.append(stream)
        if calibration is not None:
            body = json.dumps(calibration).encode()
            container.add_attachment("calibration.json", "application/octet-stream", body)
        for k, (color, depth) in enumerate(images):
            frames = (
                av.VideoFrame.from_ndarray(color, format="rgb24").reformat(format=pixel_format),
                av.VideoFrame.from_ndarray(depth.astype(np.uint16), format="gray16be"),
            )
            for stream, frame in zip(streams, frames, strict=True):
                frame.pts = k
                container.mux(stream.encode(frame))
        for stream in streams:
            container.mux(stream.encode(None))
    header = b"\1\0\x10\0"  # One plane of 16 bits per pixel in BITMAPINFOHEADER.
    path.write_bytes(path.read_bytes().replace(header + bytes(4), header + b"b16g", 1))
    return path
