"""Sequences of RGB-D frames: recordings in common layouts, and synthetic scenes."""

import re
from pathlib import Path

from ldo_service.errors import ConfigError, DataError
from ldo_service.geometry import RawFrame
from ldo_service.geometry.sequence import Cached, Sequence
from ldo_service.synthetic import open_synthetic

from .azure_kinect import SUFFIX, AzureKinectSequence
from .icl_nuim import IclNuimSequence
from .kitti import KittiSequence
from .layout import Layout, registered_layouts
from .nerfstudio import NerfstudioSequence
from .open3d import Open3dSequence
from .record3d import Record3DSequence
from .replica import ReplicaSequence
from .rig import SequenceOptions
from .ros_bag import RosBagSequence, is_bag
from .scannet import ScanNetSequence
from .sens import SensSequence
from .seven_scenes import SevenScenesSequence
from .stray_scanner import StrayScannerSequence
from .tum import TumSequence

__all__ = [
    "Cached",
    "Layout",
    "RawFrame",
    "Sequence",
    "SequenceOptions",
    "find_layout",
    "open_sequence",
]

# Layouts of this package. The first one that matches a path opens it.
LAYOUTS = (
    Layout(
        "TUM RGB-D",
        "rgb.txt and depth.txt",
        lambda path: (path / "rgb.txt").is_file() and (path / "depth.txt").is_file(),
        lambda path, _options: TumSequence(path),
    ),
    Layout(
        "Replica (NICE-SLAM)",
        "results/frame*.jpg and results/depth*.png",
        lambda path: (path / "results").is_dir(),
        lambda path, _options: ReplicaSequence(path),
    ),
    Layout(
        "Open3D, Redwood",
        "color/ (or image/, rgb/), depth/ and camera_intrinsic.json",
        Open3dSequence.matches,
        lambda path, _options: Open3dSequence(path),
    ),
    Layout(
        "ScanNet (SensReader)",
        "color/*.jpg, depth/*.png and intrinsic/",
        lambda path: (path / "color").is_dir() and (path / "depth").is_dir(),
        ScanNetSequence,
        has_options=True,
    ),
    Layout(
        "a seq-XX of 7-Scenes",
        "frame-*.color.png and frame-*.depth.png",
        lambda path: any(path.glob("frame-*.color.*")),
        SevenScenesSequence,
        has_options=True,
    ),
    Layout(
        "ICL-NUIM",
        "associations.txt, rgb/ and depth/, or scene_*.png and scene_*.depth",
        IclNuimSequence.matches,
        lambda path, _options: IclNuimSequence(path),
    ),
    Layout(
        "KITTI odometry",
        "image_2/ and image_3/ (or image_0/ and image_1/), and calib.txt",
        KittiSequence.matches,
        lambda path, _options: KittiSequence(path),
    ),
    Layout(
        "Stray Scanner",
        "rgb.mp4, depth/ and odometry.csv",
        lambda path: (path / "rgb.mp4").is_file(),
        lambda path, _options: StrayScannerSequence(path),
    ),
    Layout(
        "Record3D",
        "a file .r3d",
        lambda path: path.is_file() and path.suffix.lower() == ".r3d",
        lambda path, _options: Record3DSequence(path),
    ),
    Layout(
        "Azure Kinect",
        "a file .mkv",
        lambda path: path.is_file() and path.suffix.lower() == SUFFIX,
        lambda path, _options: AzureKinectSequence(path),
    ),
    Layout(
        "nerfstudio",
        "transforms.json with depth_file_path",
        lambda path: (path / "transforms.json").is_file(),
        lambda path, _options: NerfstudioSequence(path),
    ),
    Layout(
        "ScanNet (.sens)",
        "a file .sens",
        lambda path: path.is_file() and path.suffix.lower() == ".sens",
        SensSequence,
        has_options=True,
    ),
    Layout(
        "a bag of ROS",
        "a file .bag, .mcap or .db3, or a folder with metadata.yaml",
        is_bag,
        RosBagSequence,
        has_options=True,
        has_topics=True,
    ),
)

MAX_SEARCHED = 200  # Maximum number of entries of a folder that may be recordings themselves.


def open_sequence(source: str, options: SequenceOptions | None = None) -> Sequence:
    """Open a sequence of frames.

    Args:
        source: A path, whose layout is detected, or `synthetic[:name]`. Other packages may add
            layouts, see `Layout`.
        options: Registration of depth to color, and topics of ROS bags; None uses the defaults. A
            layout accepts only the options that apply to it.

    Raises:
        DataError: The source does not exist or has no known layout.
        ConfigError: The layout does not support the options.
    """
    options = options or SequenceOptions()
    scheme, _, name = source.partition(":")
    if scheme == "synthetic":
        if not options.is_default:
            raise ConfigError(
                f"the depth of {source} is registered to color already. Remove "
                "dataset.register_depth and dataset.T_color_depth; in Python, remove the "
                "registration options of SequenceOptions."
            )
        return open_synthetic(name or "room")
    path = Path(source).expanduser()
    if not path.exists():
        raise DataError(
            f"{source} does not exist. Check the path, or give a built-in scene, such as "
            "synthetic:room. `ldo run --help` lists the scenes."
        )
    if layout := find_layout(path):
        return layout.open_sequence(path, options)
    raise DataError(_unknown(path))


def find_layout(path: Path) -> Layout | None:
    """Return the layout that a path has, or None if it has none of the known layouts.

    The layouts of other packages are loaded only if no layout of this package matches.
    """
    for layouts in (lambda: LAYOUTS, registered_layouts):
        for layout in layouts():
            if layout.matches(path):
                return layout
    return None


def _unknown(path: Path) -> str:
    """Return the error of a path that has no known layout."""
    if parts := sorted(part.parent.name for part in path.glob("seq-*/frame-000000.color.*")):
        return (
            f"{path} contains several sequences of 7-Scenes. Give one of them, such as "
            f"{path / parts[0]}."
        )
    layouts = (*LAYOUTS, *registered_layouts())
    known = (
        f"Known are {', '.join(layout.name for layout in layouts)}: docs/first-steps.md lists "
        "their files."
    )
    if not path.is_dir():
        return f"the file {path} has no known layout. {known}"
    entries = sorted(entry for entry in path.iterdir() if not entry.name.startswith("."))
    if inner := next((entry for entry in entries[:MAX_SEARCHED] if find_layout(entry)), None):
        return (
            f"the folder {path} is no recording, but contains recordings. Give one of them, such "
            f"as {inner}, or give the folder to `ldo batch`."
        )
    names = [entry.name for entry in entries]
    similar = [layout for layout in layouts if any(_is_listed(n, layout.files) for n in names)]
    if similar:
        files = " or ".join(f"{layout.files} ({layout.name})" for layout in similar[:2])
        return (
            f"the folder {path} has no known layout. Expected {files}. docs/first-steps.md lists "
            "the files of each layout."
        )
    content = ", ".join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")
    return f"the folder {path} has no known layout; it contains {content or 'nothing'}. {known}"


def _is_listed(name: str, files: str) -> bool:
    """Return whether `files`, the description of a layout, contains the file name `name`."""
    return re.search(rf"(?<![\w./*]){re.escape(name)}(?![\w.])", files) is not None
