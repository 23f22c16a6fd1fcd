"""Fuzz targets for data sets: each kind of file in each layout, next to valid files."""

import json
import tempfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from tempfile import TemporaryDirectory
from zipfile import ZipFile

import cv2
import numpy as np

from ldo_service.datasets import icl_nuim, open_sequence
from ldo_service.geometry import Camera, RawFrame
from tests.datasets.bags import COLOR_INFO, info_of, lossless, write_bag
from tests.datasets.recordings import (
    AZURE_DEPTH_SIZE,
    azure_calibration,
    change_archive,
    small_frames,
    write_azure,
    write_icl_nuim,
    write_kitti,
    write_nerfstudio,
    write_r3d,
    write_sens,
    write_stray,
)

from .target import Target, as_file, in_folder

WIDTH, HEIGHT = 40, 32
COLOR = np.random.default_rng(7).integers(0, 255, (HEIGHT, WIDTH, 3), np.uint8)
DEPTH = np.full((HEIGHT, WIDTH), 1500, np.uint16)
POSE = b"1 0 0 0.5\n0 1 0 0\n0 0 1 -2e-1\n0 0 0 1\n"
INTRINSICS = b"40 0 19.5\n0 41 15.5\n0 0 1\n"
INTRINSICS_4 = b"40 0 19.5 0\n0 41 15.5 0\n0 0 1 0\n0 0 0 1\n"
PINHOLE = {"fx": 40.0, "fy": 41.0, "cx": 19.5, "cy": 15.5}
LISTED = b"# stamp file\n0.1 rgb/a.png\n0.2 rgb/a.png\n"
TRAJECTORY = b"# stamp tx ty tz qx qy qz qw\n0.1 0 0 0 0 0 0 1\n0.2 1 -2e0 3.5 0 0.6 0 0.8\n"


def png(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".png", pixels)[1].tobytes()


def jpeg(pixels: np.ndarray) -> bytes:
    return cv2.imencode(".jpg", pixels)[1].tobytes()


TUM = {
    "rgb.txt": LISTED,
    "depth.txt": LISTED.replace(b"rgb/", b"depth/"),
    "camera.json": json.dumps(
        {
            **PINHOLE,
            "width": WIDTH,
            "height": HEIGHT,
            "distortion": [0.1, 0, 0, 0],
            "depth_scale": 9,
        }
    ).encode(),
    "groundtruth.txt": TRAJECTORY,
    "rgb/a.png": png(COLOR),
    "depth/a.png": png(DEPTH),
}
REPLICA = {
    "cam_params.json": json.dumps(
        {"camera": {**PINHOLE, "w": WIDTH, "h": HEIGHT, "scale": 1000.0}}
    ).encode(),
    "traj.txt": b"1 0 0 0.5 0 1 0 0 0 0 1 0 0 0 0 1\n" * 2,
    "labels.json": b'{"classes": {"0": "undefined", "1": "sofa"}}',
    "results/frame000000.jpg": jpeg(COLOR),
    "results/depth000000.png": png(DEPTH),
    "semantic_class/000000.png": png(DEPTH.astype(np.uint8)),
    "instance/000000.png": png(DEPTH),
}
SCANNET = {
    "intrinsic/intrinsic_color.txt": INTRINSICS_4,
    "intrinsic/intrinsic_depth.txt": INTRINSICS_4,
    "intrinsic/extrinsic_depth.txt": POSE,
    "color/0.jpg": jpeg(COLOR),
    "depth/0.png": png(DEPTH),
    "pose/0.txt": POSE,
}
SEVEN_SCENES = {
    "camera-intrinsics.txt": INTRINSICS,
    "frame-000000.color.png": png(COLOR),
    "frame-000000.depth.png": png(DEPTH),
    "frame-000000.pose.txt": POSE,
}
FRAMES = small_frames(2, WIDTH, HEIGHT)


def written(write: Callable[[Path], object]) -> dict[str, bytes]:
    """Return the files that a writer writes into a folder, by their paths in it."""
    with TemporaryDirectory() as folder:
        write(Path(folder))
        paths = [path for path in sorted(Path(folder).rglob("*")) if path.is_file()]
        return {str(path.relative_to(folder)): path.read_bytes() for path in paths}


STRAY = written(lambda folder: write_stray(folder, FRAMES, (20, 16)))
NERFSTUDIO = written(lambda folder: write_nerfstudio(folder, FRAMES, (20, 16)))
[R3D] = written(lambda folder: write_r3d(folder / "a.r3d", FRAMES, (20, 16))).values()
[SENS] = written(lambda folder: write_sens(folder / "a.sens", FRAMES, ".png")).values()
[SENS_RAW] = written(lambda folder: write_sens(folder / "a.sens", FRAMES, "", False)).values()
OPEN3D = {
    "color/0.jpg": jpeg(COLOR),
    "depth/0.png": png(DEPTH),
    "intrinsic.json": json.dumps(
        {
            "width": WIDTH,
            "height": HEIGHT,
            "intrinsic_matrix": [40.0, 0, 0, 0, 41.0, 0, 19.5, 15.5, 1],
        }
    ).encode(),
}
POSES = np.tile(np.eye(4), (2, 1, 1))
STAMPS_NS = np.array([0, 10**8])
KITTI = written(
    lambda folder: write_kitti(
        folder, [(COLOR, COLOR)] * 2, Camera(WIDTH, HEIGHT, **PINHOLE), 0.5, STAMPS_NS, POSES
    )
)
BLACK = np.zeros((480, 640, 3), np.uint8)  # The camera of ICL-NUIM has 640x480 pixels.
ICL_FRAME = RawFrame(0, 0, BLACK, np.ones((480, 640)), 1.0, icl_nuim.CAMERA)
ICL_NUIM = written(lambda folder: write_icl_nuim(folder, [ICL_FRAME], POSES[:1]))
RENDERED = {
    "scene_00_0000.png": png(BLACK),
    "scene_00_0000.depth": b"1 " * (640 * 480),
    "a.gt.freiburg": TRAJECTORY,
}
[AZURE] = written(
    lambda folder: write_azure(
        folder / "a.mkv",
        [(COLOR, np.full(AZURE_DEPTH_SIZE[::-1], 1500))] * 2,
        azure_calibration(Camera(WIDTH, HEIGHT, **PINHOLE), Camera(320, 288, 250, 250, 160, 144)),
    )
).values()
LAYOUTS = {"TUM": TUM, "Replica": REPLICA, "ScanNet": SCANNET, "7-Scenes": SEVEN_SCENES}
LAYOUTS |= {"Stray Scanner": STRAY, "nerfstudio": NERFSTUDIO, "Open3D": OPEN3D}
LAYOUTS |= {"KITTI": KITTI, "ICL-NUIM": ICL_NUIM, "ICL-NUIM, rendered": RENDERED}


def frames_of(folder: Path) -> None:
    """Read all that a run reads from a data set."""
    sequence = open_sequence(str(folder))
    sequence.truth()
    sequence.odometry()
    labels = sequence.true_labels()
    for index in range(min(len(sequence), 2)):
        if labels is not None:
            labels.frame(index)
        assert sequence[index].depth_m.shape == (sequence.camera.height, sequence.camera.width)


def in_r3d(name: str) -> Target:
    """Return a target for a file in an archive of Record3D."""

    def frames_of_archive(path: Path) -> None:
        content = path.read_bytes()
        path.write_bytes(R3D)
        change_archive(path, {name: content})
        frames_of(path)

    with ZipFile(BytesIO(R3D)) as archive:
        seed = archive.read(name)
    return Target(f"Record3D: {name}", as_file("a.r3d", frames_of_archive), [seed])


def bag(kind: str, *files: str) -> list[bytes]:
    """Return the files of a bag with two frames."""
    camera = Camera(WIDTH, HEIGHT, 40.0, 41.0, 19.5, 15.5, (0.1, 0, 0, 0, 0))
    entries = [(1, COLOR_INFO, info_of(camera))]
    for stamp_ns in (10**9, 2 * 10**9):
        raw = RawFrame(0, stamp_ns, COLOR, DEPTH, 1000.0, camera)
        entries += [(stamp_ns, topic, message) for topic, message in lossless(raw)]
    with tempfile.TemporaryDirectory() as name:
        path = write_bag(Path(name), kind, entries)
        return [(path / file).read_bytes() for file in files] or [path.read_bytes()]


MCAP, METADATA = bag("mcap", "bag.mcap", "metadata.yaml")

TARGETS = [
    *(
        Target(f"{layout}: {name}", in_folder(name, frames_of, files), [body])
        for layout, files in LAYOUTS.items()
        for name, body in files.items()
    ),
    Target("bag of ROS 1", as_file("bag.bag", frames_of), bag("ros1")),
    Target("bag in MCAP", as_file("bag.mcap", frames_of), [MCAP]),
    Target("bag in sqlite", as_file("bag.db3", frames_of), bag("sqlite3", "bag.db3")),
    Target(
        "metadata of a bag", in_folder("metadata.yaml", frames_of, {"bag.mcap": MCAP}), [METADATA]
    ),
]
TARGETS += [
    Target("Record3D", as_file("a.r3d", frames_of), [R3D]),
    *(in_r3d(name) for name in ("metadata", "rgbd/0.jpg", "rgbd/0.depth", "rgbd/0.conf")),
    Target("Azure Kinect", as_file("a.mkv", frames_of), [AZURE]),
    Target(".sens", as_file("a.sens", frames_of), [SENS, SENS_RAW]),
]
