"""Writers of frames in the formats of phones and scanners, by their published descriptions."""

from collections.abc import Sequence
from pathlib import Path

import av
import cv2
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
