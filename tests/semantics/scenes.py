"""A small room with exact objects: what a perfect detector says of each keyframe, and a real map.

Solids are ray cast, so that depth, instances and boxes are exact; the map of Gaussians is built
from the keyframes as the mapper builds it, and labelled as the mapper labels it.
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
from ldo_service.semantics.objects import Objects, ObjectUpdate
from ldo_service.semantics.semantic_fusion import SemanticFusionConfig, fuse_detections
from ldo_service.synthetic.path import look_at
from ldo_service.synthetic.ray_casting import RayCaster
from ldo_service.synthetic.solids import Solid

CAMERA = Camera(128, 96, 104.0, 104.0, 63.5, 47.5)
SHELL = Solid("box", (0, 0, 1.25), (4.4, 4.0, 2.5), "")
NAMES = Vocabulary()
MIN_PIXELS = 40  # that a detector needs


@dataclass(frozen=True)
class Thing:
    name: str
    solid: Solid

    @property
    def label(self) -> int:
        return NAMES.index(self.name)


THINGS = (
    Thing("couch", Solid("box", (-0.9, 1.6, 0.4), (1.5, 0.6, 0.8), "")),
    Thing("dining table", Solid("box", (0.9, 1.2, 0.35), (0.9, 0.7, 0.7), "", (0.8, 0.6))),
    Thing("vase", Solid("cylinder", (0.9, 1.2, 0.9), (0.22, 0.22, 0.4), "")),
    Thing("chair", Solid("box", (-1.6, -0.2, 0.45), (0.5, 0.5, 0.9), "", (0.6, 0.8))),
    Thing("chair", Solid("box", (1.7, -0.3, 0.45), (0.5, 0.5, 0.9), "")),
    Thing("sports ball", Solid("ball", (0.0, 0.9, 0.2), (0.4, 0.4, 0.4), "")),
)


def poses(count: int, turns: float = 1.0) -> np.ndarray:
    """T_world_camera [count, 4, 4] of a camera that sways in the middle and looks from side to
    side, `turns` times there and back."""
    angle = 1.15 * np.sin(2 * np.pi * turns * np.arange(count) / count)
    eyes = np.stack([0.5 * np.sin(angle), -1.5 + 0.3 * np.cos(angle), 1.5 + 0 * angle], axis=1)
    ahead = np.stack([2.4 * np.sin(angle), 2.4 * np.cos(angle), -1.0 + 0 * angle], axis=1)
    return np.array([look_at(eye, eye + d) for eye, d in zip(eyes, ahead, strict=True)])


@dataclass(frozen=True, eq=False)
class Shot:
    """What a camera sees: instances [H, W], 0 for the room, else 1 + the number of the thing."""

    frame: RgbdFrame
    T_map_camera: np.ndarray
    instances: np.ndarray

    def claims(self, things: Sequence[Thing]) -> RegionDetections:
        """True boxes and names of what shows enough pixels."""
        boxes, labels = [], []
        for number, thing in enumerate(things, 1):
            v, u = np.nonzero(self.instances == number)
            if len(u) >= MIN_PIXELS:
                boxes.append([u.min() - 0.5, v.min() - 0.5, u.max() + 0.5, v.max() + 0.5])
                labels.append(thing.label)
        scores = np.full(len(boxes), 0.9, np.float32)
        return RegionDetections.of_detector(
            np.array(boxes).reshape(-1, 4), np.array(labels, int), scores
        )


def shoot(things: Sequence[Thing], T_world_camera: np.ndarray, index: int = 0) -> Shot:
    """The map's frame is the world's."""
    v, u = np.divmod(np.arange(CAMERA.width * CAMERA.height), CAMERA.width)
    view = RayCaster(SHELL, tuple(thing.solid for thing in things), CAMERA, T_world_camera)
    hits = view.cast(u, v)
    point = np.stack(view.points(u, v, hits.depth_m))
    paint = np.random.default_rng(5).uniform(60, 200, (6 + 40, 3))[hits.surface]
    pattern = 30 * np.sign(np.sin(9 * point[0]) * np.sin(9 * point[1]) * np.sin(9 * point[2] + 1))
    color = np.clip(paint + pattern[:, None], 0, 255).astype(np.uint8)
    size = CAMERA.height, CAMERA.width
    depth_m = hits.depth_m.reshape(size).astype(np.float32)
    frame = RgbdFrame(color.reshape(*size, 3), depth_m, CAMERA, index * 10**8, index)
    instances = np.maximum(hits.surface - 5, 0).reshape(size)
    return Shot(frame, T_world_camera, instances)


def true_things(p_map: np.ndarray, things: Sequence[Thing], way: np.ndarray) -> np.ndarray:
    """Number of the thing [N] on whose true surface each point [N, 3] lies, within 3 cm of the
    depth that some pose sees of it; -1 of the room's."""
    p_map = p_map.astype(float)
    out = np.full(len(p_map), -1)
    for T in way:
        shot = shoot(things, T)
        camera, p = shot.frame.camera, se3.transform(se3.inverse(T), p_map)
        u, v = np.rint(camera.project(np.maximum(p, [-np.inf, -np.inf, 0.1]))).astype(int).T
        inside = (p[:, 2] > 0.1) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
        at = np.flatnonzero(inside)
        on = np.abs(shot.frame.depth_m[v[at], u[at]] - p[at, 2]) < 0.03
        out[at[on]] = np.maximum(out[at[on]], shot.instances[v[at[on]], u[at[on]]] - 1)
    return out


@dataclass
class Stage:
    """The map, its labels and its objects, fed keyframe by keyframe."""

    objects: Objects = field(default_factory=Objects)
    labelling: SemanticFusionConfig = field(default_factory=SemanticFusionConfig)
    iterations: int = 3

    def __post_init__(self) -> None:
        self.builder = MapBuilder(threads=1)
        self._labels, self._ids = new_labels(0), np.zeros(0, np.int64)
        self.keyframe = 0

    def labels(self) -> np.ndarray:
        """Rows [N, 32] of the map as it is now; it may have grown, and been pruned."""
        ids = self.builder.gaussians.ids
        now = new_labels(len(ids))
        _, at, before = np.intersect1d(ids, self._ids, return_indices=True)
        now[at] = self._labels[before]
        self._labels, self._ids = now, ids.copy()
        return now

    def show(self, shot: Shot, claims: RegionDetections) -> tuple[MapView, ObjectUpdate]:
        """Map, label and observe one keyframe."""
        self.builder.add(shot.frame, shot.T_map_camera, self.keyframe, self.iterations)
        view = self.view(shot, claims)
        observed = self.objects.observe(view)
        self.keyframe += 1
        return view, observed

    def view(self, shot: Shot, claims: RegionDetections) -> MapView:
        shown = self.builder.render_from(
            CAMERA, shot.T_map_camera, contributions=True
        ).contributions
        assert shown is not None
        gaussians, depth_m = self.builder.gaussians, shot.frame.depth_m
        labels, at = self.labels(), (CAMERA, shot.T_map_camera)
        labelled = fuse_detections(
            gaussians.rows, labels, shown.indices, *at, depth_m, claims, self.labelling
        )
        return MapView(
            self.keyframe,
            *at,
            *(gaussians.rows, labels, gaussians.ids, gaussians.anchors),
            *(shown.indices, labelled.assigned.regions),
            *(claims.boxes, claims.classes(), depth_m),
        )

    def walk(self, things: Sequence[Thing], T_world_camera: np.ndarray) -> Iterator[ObjectUpdate]:
        for T in T_world_camera:
            shot = shoot(things, T, self.keyframe)
            yield self.show(shot, shot.claims(things))[1]
