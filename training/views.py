"""Frames of rooms at the size of the networks' input, and the boxes of what is seen in them."""

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

VERSION = 2  # of what is kept of a room: to be raised when `regions` or the segments change
WIDTH_PX, HEIGHT_PX = 320, 240
EYE_M = (1.2, 1.6)  # above the floor, as a hand holds a camera
GAZE_SLOPE = (-0.45, 0.05)
CLEARANCE_M = 0.3  # of the eye from things
WALL_AHEAD_M = 1.3  # nearer to a wall, nobody looks at it
GLANCES, NEAR_M = 2, 3.0  # before a frame is taken where most is to be seen, within so much
SHARE_MIN = 3.9e-4  # of the image, of an object that is told: 30 pixels
WINDOWS = 6  # tried per frame for a piece of the building
PURITY = 0.8  # of such a window


@dataclass(frozen=True, slots=True)
class VisibleBoxes:
    """B boxes in F frames.

    frames     [B] index of the frame
    class_ids  [B] into CLASS_NAMES; of a region that shows no thing -1
    instances  [B] id in the frame's plane of instances, 0 for the building and for no thing
    boxes_px   [B, 4] x0, y0, x1, y1 counted from the corner of the first pixel
    pixels     [B] visible of the object, within a region; of no thing, all of the region's
    """

    frames: np.ndarray
    class_ids: np.ndarray
    instances: np.ndarray
    boxes_px: np.ndarray
    pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.frames)

    def chosen(self, which: np.ndarray) -> "VisibleBoxes":
        return VisibleBoxes(*(getattr(self, name)[which] for name in self.__slots__))

    def scaled(self, scale: float) -> "VisibleBoxes":
        """In frames of another size."""
        return replace(self, boxes_px=self.boxes_px * scale, pixels=self.pixels * scale**2)

    def table(self) -> np.ndarray:
        """Rows [B, 8], one per box."""
        columns = self.frames, self.class_ids, self.instances, self.boxes_px, self.pixels
        return np.column_stack(columns)

    @staticmethod
    def of(table: np.ndarray) -> "VisibleBoxes":
        ids = table[:, :3].astype(np.int64)
        return VisibleBoxes(*ids.T, table[:, 3:7], table[:, 7])


@dataclass(frozen=True, slots=True)
class Views:
    """colors [F, H, W, 3] uint8 RGB, sharp and without noise, and what they show.

    instances  [F, H, W] uint8, 0 for the building
    regions    those that the service would set apart, see `regions`
    """

    colors: np.ndarray
    instances: np.ndarray
    seen: VisibleBoxes
    regions: VisibleBoxes


def camera() -> Camera:
    """The flat's lens."""
    focal_px = FOCAL_PER_WIDTH * WIDTH_PX
    center_px = (WIDTH_PX - 1) / 2, (HEIGHT_PX - 1) / 2
    return Camera(WIDTH_PX, HEIGHT_PX, focal_px, focal_px, *center_px)


def render(seed: int, count: int) -> Views:
    """`count` frames of the room of this seed."""
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
    """As `render`, kept in a folder."""
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
    """Objects in frames of class and instance ids [H, W]; with `rng`, bare walls and floors too."""
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
    """Class, instance, box, pixels of each object."""
    for instance in np.unique(instance_ids):
        v, u = np.nonzero(instance_ids == instance)
        if instance and len(v) >= SHARE_MIN * instance_ids.size:
            box = u.min(), v.min(), u.max() + 1, v.max() + 1
            yield class_ids[v[0], u[0]], instance, *box, len(v)


def _building(class_ids: np.ndarray, rng: np.random.Generator) -> Iterator[tuple]:
    """Windows on the bare wall, floor or ceiling."""
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
    """T_world_camera [count, 4, 4] of eyes where nothing stands; of a few that look anywhere, those
    before which most things are."""
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
    """How many have their middle in the image, and are near."""
    x, y, z = ((centers_m - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]).T
    half_x, half_y = 0.5 / FOCAL_PER_WIDTH, 0.5 * HEIGHT_PX / WIDTH_PX / FOCAL_PER_WIDTH
    is_near = (z > 0) & (z < NEAR_M)
    return int(np.sum(is_near & (np.abs(x) < half_x * z) & (np.abs(y) < half_y * z)))
