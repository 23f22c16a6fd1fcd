"""Frames of rooms, with the boxes of visible objects and of region proposals."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import layout
import numpy as np
from regions import regions

from ldo_service.geometry import Camera
from ldo_service.synthetic.flat.render import FlatRenderer
from ldo_service.synthetic.flat.scene import Flat
from ldo_service.synthetic.flat.scene_object import CEILING, FLOOR, WALL
from ldo_service.synthetic.flat.sequence import FOCAL_PER_WIDTH
from ldo_service.synthetic.path import look_at

VERSION = 2  # Version of the cached rooms; increase it when `regions` or the segmentation change.
WIDTH_PX, HEIGHT_PX = 320, 240
EYE_M = (1.2, 1.6)  # Range of the camera's height above the floor, as if held in a hand.
# Range of the vertical component of the viewing direction, whose horizontal part has length 1.
GAZE_SLOPE = (-0.45, 0.05)
CLEARANCE_M = 0.3  # Minimum distance of the camera to objects.
WALL_AHEAD_M = 1.3  # Minimum distance to the wall in front of the camera.
# Candidate poses per frame, and the depth up to which the objects in view are counted. The pose
# with the most objects is used.
GLANCES, NEAR_M = 2, 3.0
SHARE_MIN = 3.9e-4  # Minimum size of an object, as a fraction of the image: 30 pixels.
# Random rectangles per frame. A rectangle that shows a bare wall, floor or ceiling becomes a
# training example of this class.
WINDOWS = 6
PURITY = 0.8  # Minimum fraction of such a rectangle that the wall, floor or ceiling covers.


@dataclass(frozen=True, slots=True)
class VisibleBoxes:
    """B boxes of objects or regions in F frames."""

    frames: np.ndarray  # Index [B] of the frame.
    class_ids: np.ndarray  # Index [B] into CLASS_NAMES; -1 for a region without an object.
    instances: np.ndarray  # Instance id [B]; 0 for the building and for no object.
    boxes_px: np.ndarray  # Boxes [B, 4], x0, y0, x1, y1, from the corner of the first pixel.
    # Number [B] of visible pixels of the object. For a region: number of the region's pixels on the
    # object, or of all its pixels if it shows no object.
    pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    def chosen(self, which: np.ndarray) -> "VisibleBoxes":
        """Return the boxes that a mask or an array of indices selects."""
        return VisibleBoxes(*(getattr(self, name)[which] for name in self.__slots__))

    def scaled(self, scale: float) -> "VisibleBoxes":
        """Return the boxes in pixels of frames that are `scale` times as large."""
        return replace(self, boxes_px=self.boxes_px * scale, pixels=self.pixels * scale**2)

    def table(self) -> np.ndarray:
        """Return the boxes as rows [B, 8]: frame, class id, instance, x0, y0, x1, y1, pixels."""
        columns = self.frames, self.class_ids, self.instances, self.boxes_px, self.pixels
        return np.column_stack(columns)

    @staticmethod
    def of(table: np.ndarray) -> "VisibleBoxes":
        """Return the boxes of a table [B, 8] that `table()` returned."""
        ids = table[:, :3].astype(np.int64)
        return VisibleBoxes(*ids.T, table[:, 3:7], table[:, 7])


@dataclass(frozen=True, slots=True)
class Views:
    """F frames with their ground truth."""

    colors: np.ndarray  # RGB [F, H, W, 3] uint8, sharp and without noise.
    instances: np.ndarray  # Instance ids [F, H, W] uint8; 0 for the building.
    seen: VisibleBoxes  # Visible objects, and rectangles on bare walls, floors and ceilings.
    regions: VisibleBoxes  # Region proposals, see `regions`.


def camera() -> Camera:
    """Return the intrinsics of all frames, with the field of view of `synthetic:flat`."""
    focal_px = FOCAL_PER_WIDTH * WIDTH_PX
    center_px = (WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2
    return Camera(WIDTH_PX, HEIGHT_PX, focal_px, focal_px, *center_px)


def render(seed: int, count: int) -> Views:
    """Render `count` frames of the room that `seed` determines."""
    flat = layout.room(seed)
    renderer, lens = FlatRenderer(flat), camera()
    rng = np.random.default_rng([seed, 8])
    frames = [renderer.render(lens, T) for T in _poses(flat, count, rng)]
    colors = np.array([np.floor(frame.light * 255 + 0.5).astype(np.uint8) for frame in frames])
    planes = [(frame.class_ids, frame.instance_ids) for frame in frames]
    instances = np.array([frame.instance_ids for frame in frames])
    assert instances.max() < 256
    apart = [
        (number, *row)
        for number, frame in enumerate(frames)
        for row in regions(frame, lens, np.random.default_rng([seed, 11, number]))
    ]
    return Views(colors, instances.astype(np.uint8), seen_in(planes, rng), _seen(apart))


def cached(folder: Path, seed: int, count: int) -> Views:
    """Return the result of `render` from a file in a folder.

    If the file is missing, the frames are rendered and stored first.
    """
    file = folder / f"{VERSION}-{layout.VERSION}-{seed}-{count}.npz"
    if not file.exists():
        views = render(seed, count)
        folder.mkdir(parents=True, exist_ok=True)
        np.savez(
            file,
            colors=views.colors,
            instances=views.instances,
            seen=views.seen.table(),
            regions=views.regions.table(),
        )
    with np.load(file) as stored:
        tables = (VisibleBoxes.of(stored[name]) for name in ("seen", "regions"))
        return Views(stored["colors"], stored["instances"], *tables)


def seen_in(
    planes: list[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator | None = None
) -> VisibleBoxes:
    """Return the boxes of the visible objects in frames, and optionally of bare walls.

    Args:
        planes: Class ids [H, W] and instance ids [H, W] of each frame.
        rng: Random generator of image rectangles. Rectangles that show a bare wall, floor or
            ceiling are returned as boxes of this class. If None, only objects are returned.
    """
    rows = [
        (frame, *row)
        for frame, (class_ids, instance_ids) in enumerate(planes)
        for row in (
            *_objects(class_ids, instance_ids),
            *(_building(class_ids, rng) if rng is not None else ()),
        )
    ]
    return _seen(rows)


def _seen(rows: Sequence[tuple]) -> VisibleBoxes:
    return VisibleBoxes.of(np.array(rows, float).reshape(-1, 8))


def _objects(class_ids: np.ndarray, instance_ids: np.ndarray) -> Iterator[tuple]:
    """Yield class id, instance id, x0, y0, x1, y1 and number of pixels of each visible object."""
    for instance in np.unique(instance_ids):
        v, u = np.nonzero(instance_ids == instance)
        if instance and len(v) >= SHARE_MIN * instance_ids.size:
            box = u.min(), v.min(), u.max() + 1, v.max() + 1
            yield class_ids[v[0], u[0]], instance, *box, len(v)


def _building(class_ids: np.ndarray, rng: np.random.Generator) -> Iterator[tuple]:
    """Yield random image rectangles that show a bare wall, floor or ceiling.

    The rows have the columns of `_objects`.
    """
    height, width = class_ids.shape
    for _ in range(WINDOWS):
        w, h = rng.integers(12, 100, 2)
        left, top = rng.integers(0, width - w), rng.integers(0, height - h)
        window = class_ids[top : top + h, left : left + w]
        for surface in (WALL, FLOOR, CEILING):
            pixels = np.count_nonzero(window == surface)
            if pixels >= PURITY * window.size:
                yield surface, 0, left, top, left + w, top + h, pixels


def _poses(flat: Flat, count: int, rng: np.random.Generator) -> np.ndarray:
    """Return random camera poses T_world_camera [count, 4, 4] in free space.

    Each pose is the best of GLANCES candidates: the one with the most objects in view.
    """
    boxes = [thing.bounds_m for thing in flat.things]
    centers_m = np.array([center for center, _ in boxes])
    found = []
    for _ in range(count):
        glances = [_glance(flat, boxes, rng) for _ in range(GLANCES)]
        found.append(max(glances, key=lambda T: _things_before(T, centers_m)))
    return np.array(found)


def _glance(
    flat: Flat, boxes: list[tuple[np.ndarray, np.ndarray]], rng: np.random.Generator
) -> np.ndarray:
    reach = np.array(layout.inside_m(flat)) / 2 - 0.35
    while True:
        eye = np.append(rng.uniform(-reach, reach), rng.uniform(*EYE_M))
        way = rng.normal(size=2)
        way /= np.sqrt(way @ way)
        ahead = eye[:2] + WALL_AHEAD_M * way
        is_blocked = any((np.abs(eye - c) < s / 2 + CLEARANCE_M).all() for c, s in boxes)
        if not is_blocked and (np.abs(ahead) < reach + 0.35).all():
            return look_at(eye, eye + np.array([*way, rng.uniform(*GAZE_SLOPE)]))


def _things_before(T_world_camera: np.ndarray, centers_m: np.ndarray) -> int:
    """Return the number of objects whose center is in the image and at a depth below NEAR_M.

    Args:
        T_world_camera: Pose of the camera, [4, 4].
        centers_m: Centers of the objects in the world frame, [M, 3].
    """
    x, y, z = ((centers_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]).T
    half_x, half_y = 0.5 / FOCAL_PER_WIDTH, 0.5 * HEIGHT_PX / WIDTH_PX / FOCAL_PER_WIDTH
    is_near = (z > 0) & (z < NEAR_M)
    return int(np.sum(is_near & (np.abs(x) < half_x * z) & (np.abs(y) < half_y * z)))
