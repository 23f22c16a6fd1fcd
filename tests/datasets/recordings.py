"""Writers of frames in the formats of phones and scanners, by their published descriptions."""

import json
import struct
import zipfile
import zlib
from collections.abc import Sequence
from pathlib import Path

import av
import cv2
import liblzfse
import numpy as np

from ldo_service.geometry import Camera, RawFrame

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
) -> Path:
    """Write a folder of Stray Scanner; color is `enlarged` times as wide as in the frames."""
    lines = ["timestamp, frame, x, y, z, qx, qy, qz, qw"]
    for k, frame in enumerate(frames):
        depth = millimeters(frame, depth_size)
        write_image(folder / f"depth/{k:06d}.png", depth)
        write_image(folder / f"confidence/{k:06d}.png", np.where(depth > 0, 2, 0).astype(np.uint8))
        lines.append(f"{frame.stamp_ns / 1e9:.6f}, {k:06d}, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0")
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
    folder: Path, frames: list[RawFrame], depth_size: tuple[int, int] | None = None
) -> Path:
    """Write a folder of nerfstudio; depth is in the unit of the frames unless it is resampled."""
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
                "transform_matrix": np.eye(4).tolist(),
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
