"""Scene of a small room with exact objects, perfect detections and a real labelled map.

Solids are ray cast, so depth, instances and boxes are exact. The map of Gaussians is built and
labelled from the keyframes with the same components as in the mapper.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from ldo_service.detection.vocabulary import Vocabulary
from ldo_service.gaussians.map_builder import MapBuilder
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.regions.foreground import RegionDetections
from ldo_service.semantics.data_association import MapView
from ldo_service.semantics.gaussian_labels import new_labels
from ldo_service.semantics.objects import Objects
from ldo_service.semantics.observations import ObjectUpdate
from ldo_service.semantics.semantic_fusion import SemanticFusionConfig, fuse_detections
from ldo_service.synthetic.path import look_at
from ldo_service.synthetic.ray_casting import RayCaster
from ldo_service.synthetic.solids import Solid

CAMERA = Camera(128, 96, 104.0, 104.0, 63.5, 47.5)
SHELL = Solid("box", (0, 0, 1.25), (4.4, 4.0, 2.5), "")
NAMES = Vocabulary()
MIN_PIXELS = 40  # Smallest object that a detector reports.
NO_DETECTIONS = RegionDetections.of_detector(
    np.zeros((0, 4)), np.zeros(0, int), np.zeros(0, np.float32)
)


@dataclass(frozen=True)
class SceneObject:
    name: str
    solid: Solid

    @property
    def label(self) -> int:
        return NAMES.index(self.name)


SCENE_OBJECTS = (
    SceneObject("couch", Solid("box", (-0.9, 1.6, 0.4), (1.5, 0.6, 0.8), "")),
    SceneObject("dining table", Solid("box", (0.9, 1.2, 0.35), (0.9, 0.7, 0.7), "", (0.8, 0.6))),
    SceneObject("vase", Solid("cylinder", (0.9, 1.2, 0.9), (0.22, 0.22, 0.4), "")),
    SceneObject("chair", Solid("box", (-1.6, -0.2, 0.45), (0.5, 0.5, 0.9), "", (0.6, 0.8))),
    SceneObject("chair", Solid("box", (1.7, -0.3, 0.45), (0.5, 0.5, 0.9), "")),
    SceneObject("sports ball", Solid("ball", (0.0, 0.9, 0.2), (0.4, 0.4, 0.4), "")),
)


def poses(count: int, turns: float = 1.0) -> np.ndarray:
    """Return T_world_camera [count, 4, 4] of a camera that looks from side to side.

    The camera sways in the middle of the room and completes `turns` periods.
    """
    angle = 1.15 * np.sin(2 * np.pi * turns * np.arange(count) / count)
    eyes = np.stack([0.5 * np.sin(angle), -1.5 + 0.3 * np.cos(angle), 1.5 + 0 * angle], axis=1)
    ahead = np.stack([2.4 * np.sin(angle), 2.4 * np.cos(angle), -1.0 + 0 * angle], axis=1)
    return np.array([look_at(eye, eye + d) for eye, d in zip(eyes, ahead, strict=True)])


@dataclass(frozen=True, eq=False)
class Shot:
    """RGB-D frame with instances [H, W]: 0 for the room, else 1 + the index of the object."""

    frame: RgbdFrame
    T_map_camera: np.ndarray
    instances: np.ndarray

    def detections(self, objects: Sequence[SceneObject]) -> RegionDetections:
        """Return true boxes and labels of the objects that show enough pixels."""
        boxes, labels = [], []
        for instance, item in enumerate(objects, 1):
            v, u = np.nonzero(self.instances == instance)
            if len(u) >= MIN_PIXELS:
                boxes.append([u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5])
                labels.append(item.label)
        scores = np.full(len(boxes), 0.9, np.float32)
        return RegionDetections.of_detector(
            np.array(boxes).reshape(-1, 4), np.array(labels, int), scores
        )


def shoot(objects: Sequence[SceneObject], T_world_camera: np.ndarray, index: int = 0) -> Shot:
    """Render the objects from a pose; the map frame is the world frame."""
    v, u = np.divmod(np.arange(CAMERA.width * CAMERA.height), CAMERA.width)
    view = RayCaster(SHELL, tuple(item.solid for item in objects), CAMERA, T_world_camera)
    hits = view.cast(u, v)
    point = np.stack(hits.point)
    paint = np.random.default_rng(5).uniform(60, 200, (6 + 40, 3))[hits.surface]
    pattern = 30 * np.sign(np.sin(9 * point[0]) * np.sin(9 * point[1]) * np.sin(9 * point[2] + 1))
    color = np.clip(paint + pattern[:, None], 0, 255).astype(np.uint8)
    size = CAMERA.height, CAMERA.width
    depth_m = hits.depth_m.reshape(size).astype(np.float32)
    frame = RgbdFrame(color.reshape(*size, 3), depth_m, CAMERA, index * 10**8, index)
    instances = np.maximum(hits.surface - 5, 0).reshape(size)
    return Shot(frame, T_world_camera, instances)


def true_objects(
    p_map: np.ndarray, objects: Sequence[SceneObject], T_world_camera: np.ndarray
) -> np.ndarray:
    """Return the index [N] of the object that each point [N, 3] belongs to.

    A point belongs to an object if it lies within 3 cm of its true depth, rendered from any of
    the poses. The index is -1 for points of the room.
    """
    p_map = p_map.astype(float)
    out = np.full(len(p_map), -1)
    for T in T_world_camera:
        shot = shoot(objects, T)
        camera, p = shot.frame.camera, se3.transform(se3.inverse(T), p_map)
        u, v = np.rint(camera.project(np.maximum(p, [-np.inf, -np.inf, 0.1]))).astype(int).T
        inside = (p[:, 2] > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        at = np.flatnonzero(inside)
        on = np.abs(shot.frame.depth_m[v[at], u[at]] - p[at, 2]) < 0.03
        out[at[on]] = np.maximum(out[at[on]], shot.instances[v[at[on]], u[at[on]]] - 1)
    return out


@dataclass
class LabelledMap:
    """Map with labels and objects, built keyframe by keyframe."""

    objects: Objects = field(default_factory=Objects)
    labelling: SemanticFusionConfig = field(default_factory=SemanticFusionConfig)
    iterations: int = 3

    def __post_init__(self) -> None:
        self.builder = MapBuilder(threads=1)
        self._labels, self._ids = new_labels(0), np.zeros(0, np.int64)
        self.keyframe = 0

    def labels(self) -> np.ndarray:
        """Return the label rows [N, 32] of the present map, also after growth and pruning."""
        ids = self.builder.gaussians.ids
        now = new_labels(len(ids))
        _, at, before = np.intersect1d(ids, self._ids, return_indices=True)
        now[at] = self._labels[before]
        self._labels, self._ids = now, ids.copy()
        return now

    def show(self, shot: Shot, detections: RegionDetections) -> tuple[MapView, ObjectUpdate]:
        """Map, label and observe one keyframe.

        Returns:
            The view that the objects observed, and their update.
        """
        self.builder.add(shot.frame, shot.T_map_camera, self.keyframe, self.iterations)
        view = self.view(shot, detections)
        observed = self.objects.observe(view)
        self.keyframe += 1
        return view, observed

    def view(self, shot: Shot, detections: RegionDetections) -> MapView:
        shown = self.builder.render_from(
            CAMERA, shot.T_map_camera, contributions=True
        ).contributions
        assert shown is not None
        gaussians, depth_m = self.builder.gaussians, shot.frame.depth_m
        labels, pose = self.labels(), (CAMERA, shot.T_map_camera)
        labelled = fuse_detections(
            gaussians.rows, labels, shown.indices, *pose, depth_m, detections, self.labelling
        )
        return MapView(
            self.keyframe,
            *pose,
            *(gaussians.rows, labels, gaussians.ids, gaussians.anchors),
            *(shown.indices, labelled.assigned.regions),
            *(detections.boxes, detections.classes(), depth_m),
        )

    def walk(
        self, objects: Sequence[SceneObject], T_world_camera: np.ndarray
    ) -> Iterator[ObjectUpdate]:
        """Observe the objects with perfect detections from each pose and yield the updates."""
        for T in T_world_camera:
            shot = shoot(objects, T, self.keyframe)
            yield self.show(shot, shot.detections(objects))[1]
