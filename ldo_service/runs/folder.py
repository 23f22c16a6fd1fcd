"""Folder that a run writes.

trajectory_online.txt      poses of the first submap as published during the run; LOST frames are
                           omitted
trajectory.txt             poses of the first submap and of those merged with it, after the last
                           correction; LOST frames are omitted
frames.csv                 status, residuals, tracking time (ms) and submap of every frame
keyframes.json             id, frame, stamp, camera and pose of every keyframe
map.ply                    Gaussians whose anchor keyframe has a pose in the map
semantics.npz              labels of these Gaussians; format: `semantics.semantics_file`
objects.json               objects in the map; format: `runs.records`
keyframe_database.msgpack  database for `--localize`, with the final poses
loops.json                 loop candidates with their rejection reasons; format: `runs.records`
front_end.mcap             recorded outputs of tracker and detector; format: `runs.front_end`
config.yaml                effective configuration
summary.json               counts, speed, memory, versions
refined/                   trajectory, keyframes and map after further iterations

Submaps that were never merged with the first one are not in the frame of the map. Their frames are
not in the trajectories, and their Gaussians and objects are not in the map. semantics.npz and
objects.json exist only if a detector or a labeller ran. front_end.mcap and refined/ exist only if
they were requested.

A run with `--localize` makes no map. The map that it used, with keyframes.json, map.ply and
keyframe_database.msgpack, is in the folder named by tracker.localization_map in config.yaml.
"""

import csv
import io
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TextIO

import msgspec
import numpy as np

from ldo_service.actors.tracker import TrackerConfig
from ldo_service.conversions.poses import keyframe_poses_from_correction, pose_from_message
from ldo_service.errors import ConfigError
from ldo_service.gaussians.file_formats import write_ply
from ldo_service.geometry import Trajectory
from ldo_service.geometry.keyframe_poses import KeyframePoses
from ldo_service.maps.replica import MapReplica
from ldo_service.schemas import (
    DetectionBoxes,
    GraphCorrection,
    Keyframe,
    LabelResult,
    LoopCandidate,
    LoopClosure,
    MapDelta,
    MapObject,
    MapObjects,
    MapSnapshot,
    Message,
    TrackedPose,
)
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.semantics.semantics_file import write_semantics
from ldo_service.tracking.keyframe_database import (
    DATABASE_FILE,
    OLD_DATABASE_FILE,
)

from .database_writer import DatabaseWriter
from .final_poses import FinalPoses, FramePose, MeasuredKeyframe
from .front_end import FRONT_END
from .records import LOOPS, OBJECTS, LoopRecord, write_objects

MAP_FILES = ("map.ply", "trajectory.txt", "keyframes.json")
SEMANTICS = "semantics.npz"
REFINED = "refined"  # Subfolder of the refined map; its files have the names of MAP_FILES.
EXPORTED = {  # Files of `ldo export` for each format.
    "ply": ("gaussians.ply",),
    "splat": ("gaussians.splat",),
    "spz": ("gaussians.spz",),
    "tum": ("trajectory.tum",),
    "csv": ("trajectory.csv",),
    "mesh": ("mesh.ply",),
    "occupancy": ("occupancy.npz", "occupancy.pgm", "occupancy.yaml"),
}
WRITTEN = frozenset(
    {
        *("trajectory_online.txt", "frames.csv", "config.yaml", "summary.json", *MAP_FILES),
        *(
            DATABASE_FILE,
            OLD_DATABASE_FILE,
            OBJECTS,
            LOOPS,
            FRONT_END,
            SEMANTICS,
            f"{REFINED}/{SEMANTICS}",
            f"{REFINED}/{OBJECTS}",
        ),
        *("trajectory.png", "rendering.png", "labels.png"),  # Files of `ldo eval` and `ldo demo`.
        "views.png",  # File of `ldo demo` up to version 0.1.
        *(f"{REFINED}/{name}" for name in MAP_FILES),
        *(name for names in EXPORTED.values() for name in names),
    }
)
CAMERA = ("width", "height", "fx", "fy", "cx", "cy")  # Rectified camera of a keyframe, pixels.
COLUMNS = (
    *("frame", "stamp_ns", "status", "reference", "keyframe", "held_out"),
    *("inlier_fraction", "residual_color", "residual_depth", "overlap", "iterations", "track_ms"),
    *("submap", "pose_source", "hypothesis_spread_rad"),
)


def prepare(folder: Path, overwrite: bool) -> None:
    """Create an empty folder for a run.

    Args:
        folder: The folder.
        overwrite: False if the folder must be empty. True to delete the files of an earlier run
            first; if the folder has other files too, nothing is deleted and ConfigError is raised.

    Raises:
        ConfigError: The folder is not empty or cannot be written.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        found = sorted(path for path in folder.rglob("*") if not path.is_dir())
        if found and not overwrite:
            raise ConfigError(
                f"{folder} is not empty. Choose another folder, or add --overwrite (in Python: "
                "overwrite=True)."
            )
        names = [path.relative_to(folder).as_posix() for path in found]
        foreign = [name for name in names if name not in WRITTEN]
        if foreign:
            raise ConfigError(
                f"{folder} holds {foreign[0]}, which no run wrote, so nothing is deleted. "
                "Choose another folder."
            )
        for path in found:
            path.unlink()
    except OSError as error:
        raise ConfigError(
            f"{folder} cannot be written: {error.strerror}. Choose another folder."
        ) from error


class RunWriter:
    """Record of the outputs of a run's actors, and writer of the run's folder.

    If the constructor gets a folder, it writes config.yaml there, and `observe` writes frames.csv
    during the run. `save` writes all files, even if the constructor got no folder.
    """

    def __init__(self, folder: Path | None, config_text: str, tracker: TrackerConfig) -> None:
        """Start a record. If `folder` is None, nothing is written before `save`."""
        self._config_text, self._hold_out = config_text, tracker.hold_out
        self._makes_map = not tracker.localize
        self._database = DatabaseWriter(tracker.odometry)
        self._csv_file: TextIO = io.StringIO(newline="")
        if folder is not None:
            (folder / "config.yaml").write_text(config_text)
            self._csv_file = (folder / "frames.csv").open("w", newline="")
        self.folder = folder
        self._csv = csv.writer(self._csv_file)
        self._csv.writerow(COLUMNS)
        self._tracked: list[FramePose] = []
        self._poses, self._final_poses = KeyframePoses(), FinalPoses()
        self._merged_submaps: dict[int, int] = {}  # Merged submap -> submap that contains it.
        self._keyframes: dict[int, dict[str, Any]] = {}
        self.replica = MapReplica()
        self._objects: MapObjects | None = None
        self.statuses = {"OK": 0, "WEAK": 0, "LOST": 0}
        self.loops = LoopRecord()
        self.boxes = 0  # Number of detections.
        self.labeller_calls = 0  # Number of label results that name a labeller.
        self.newest_stamp_ns = 0
        self.summary: dict[str, Any] = {}

    @property
    def keyframes(self) -> int:
        """Number of keyframes so far."""
        return len(self._keyframes)

    def observe(self, message: Message, step_ms: float) -> None:
        """Record one message.

        Args:
            message: Output of an actor.
            step_ms: Duration of the step that produced the message, milliseconds.
        """
        match message:
            case TrackedPose():
                self._observe_pose(message, step_ms)
            case Keyframe():
                self._observe_keyframe(message)
            case GraphCorrection():
                self.loops.observe(message, step_ms)
                self._poses.correct(message.graph_version, keyframe_poses_from_correction(message))
                self._merged_submaps = dict(message.merged_submaps)
            case DetectionBoxes():
                self.boxes += len(message.detections)
            case LabelResult():
                self.labeller_calls += bool(message.labeller)
            case MapObjects():
                self._objects = message
            case LoopCandidate() | LoopClosure():
                self.loops.observe(message, step_ms)
            case MapDelta() | MapSnapshot():
                self.replica.apply(message)

    def _observe_pose(self, pose: TrackedPose, step_ms: float) -> None:
        self.statuses[pose.status] += 1
        held_out = bool(self._hold_out) and pose.frame % self._hold_out == self._hold_out - 1
        quality = (pose.inlier_fraction, pose.residual_color, pose.residual_depth, pose.overlap)
        self._csv.writerow(
            (
                *(pose.frame, pose.stamp_ns, pose.status, pose.reference, pose.keyframe),
                int(held_out),
                *(f"{value:.4f}" for value in quality),
                *(pose.iterations, f"{step_ms:.3f}", pose.submap),
                *(pose.pose_source, f"{pose.hypothesis_spread_rad:.4f}"),
            )
        )
        if pose.status != "LOST":
            online = pose_from_message(pose.T_map_odom) @ pose_from_message(pose.T_odom_camera)
            self._tracked.append(
                FramePose(
                    pose.stamp_ns,
                    pose.reference,
                    pose_from_message(pose.T_reference_camera),
                    online,
                    pose.submap,
                )
            )

    def _observe_keyframe(self, keyframe: Keyframe) -> None:
        self._poses.add(
            keyframe.keyframe,
            keyframe.reference,
            pose_from_message(keyframe.T_reference_keyframe),
            pose_from_message(keyframe.T_odom_keyframe),
            keyframe.submap,
        )
        T_reference_keyframe = pose_from_message(keyframe.T_reference_keyframe)
        measured = MeasuredKeyframe(keyframe.stamp_ns, keyframe.keyframe, T_reference_keyframe)
        self._final_poses.add(measured, keyframe.reference)
        self._database.add(keyframe)
        self.newest_stamp_ns = keyframe.stamp_ns
        self._keyframes[keyframe.keyframe] = {
            "keyframe": keyframe.keyframe,
            "frame_index": keyframe.frame,
            "stamp_ns": keyframe.stamp_ns,
            "submap": keyframe.submap,
            "camera": {name: getattr(keyframe.camera, name) for name in CAMERA},
            "camera_correction": msgspec.to_builtins(keyframe.camera_correction),
        }

    # --- at the end -------------------------------------------------------------------------------
    def close(self, summary: dict[str, Any]) -> None:
        """Write all files to the folder of the run."""
        assert self.folder is not None
        self._csv_file.close()
        self.save(self.folder, summary)

    def save(self, folder: Path, summary: dict[str, Any]) -> None:
        """Write all files to an existing folder; more messages may be recorded afterwards.

        A writer that was created with a folder can save only to this folder.
        """
        self.folder, self.summary = folder, summary
        if isinstance(self._csv_file, io.StringIO):
            (folder / "config.yaml").write_text(self._config_text)
            (folder / "frames.csv").write_text(self._csv_file.getvalue(), newline="")
        self.online().save(folder / "trajectory_online.txt")
        self._write_map(folder)
        self.loops.save(folder)
        write_json(folder / "summary.json", summary)

    def in_map(self) -> np.ndarray:
        """Return a mask, [N] bool, of the Gaussians whose anchor keyframe has a pose in the map."""
        placed = [k for k, facts in self._keyframes.items() if self._root(facts["submap"]) == 0]
        return np.isin(self.replica.map.anchors, placed)

    def objects(self) -> tuple[MapObject, ...]:
        """Return the objects in the map; empty if no detector ran."""
        placed = self.placed_objects()
        return placed.objects if placed else ()

    def labelled(self) -> int:
        """Return the number of Gaussians in the map whose best label is not background."""
        return int(np.count_nonzero(top_labels(self.replica.map.labels[self.in_map()])))

    def write_refined(self, iterations: int) -> None:
        """Write the refined map with its keyframes and trajectory.

        Args:
            iterations: Number of iterations of the refinement.
        """
        assert self.folder is not None
        folder = self.folder / REFINED
        folder.mkdir(exist_ok=True)
        self._write_map(folder)
        self.summary["refine_iterations"] = iterations
        write_json(self.folder / "summary.json", self.summary)

    def _write_map(self, folder: Path) -> None:
        self.final().save(folder / "trajectory.txt")
        if not self._makes_map:
            return
        write_json(folder / "keyframes.json", self._placed_keyframes())
        in_map, gaussians = self.in_map(), self.replica.map
        write_ply(folder / "map.ply", gaussians.rows[in_map])
        if self.replica.label_names:
            names = self.replica.label_names
            write_semantics(folder / SEMANTICS, gaussians.labels[in_map], names)
        if (objects := self.placed_objects()) is not None:
            write_objects(folder, objects)
        assert self.folder is not None
        self._database.save(self.folder / DATABASE_FILE, self._poses, self._merged_submaps)

    def online(self) -> Trajectory:
        """Return the published T_map_camera of the first submap's frames, without LOST frames."""
        frames = [frame for frame in self._tracked if frame.submap == 0]
        return _trajectory(frames, [frame.T_map_camera_online for frame in frames])

    def final(self) -> Trajectory:
        """Return T_map_camera of each frame, computed from final keyframe poses (`FinalPoses`).

        LOST frames, and frames of submaps that were never merged with the map, are omitted.
        """
        frames = [frame for frame in self._tracked if self._root(frame.submap) == 0]
        T_map = {keyframe: self._poses[keyframe] for keyframe in self._poses}
        return _trajectory(frames, self._final_poses.of(frames, T_map))

    def _root(self, submap: int) -> int:
        """Return the submap that `submap` was merged into, or itself if it was not merged."""
        return self._merged_submaps.get(submap, submap)

    def _placed_keyframes(self) -> list[dict[str, Any]]:
        return [
            {
                **facts,
                "submap": self._root(facts["submap"]),
                "T_map_camera": self._poses[keyframe].tolist(),
                "exposure": self.replica.exposure(keyframe).tolist(),
            }
            for keyframe, facts in self._keyframes.items()
        ]

    def placed_objects(self) -> MapObjects | None:
        """Return the objects that were first observed by a keyframe with a pose in the map.

        The result is None if no detector ran.
        """
        found, keyframes = self._objects, self._keyframes
        if found is None:
            return None
        placed = tuple(
            one for one in found.objects if self._root(keyframes[one.first_keyframe]["submap"]) == 0
        )
        return msgspec.structs.replace(found, objects=placed)


def _trajectory(
    frames: Sequence[FramePose], T_map_camera: Sequence[np.ndarray] | np.ndarray
) -> Trajectory:
    stamps_s = np.array([frame.stamp_ns for frame in frames]) * 1e-9
    return Trajectory(stamps_s, np.array(T_map_camera).reshape(-1, 4, 4))


def write_json(path: Path, value: object) -> None:
    path.write_text(json.dumps(value, indent=1) + "\n")
