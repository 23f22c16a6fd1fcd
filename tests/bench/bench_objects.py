"""Time of the object steps of a keyframe and of a text search: 1000 objects, 100,000 Gaussians.

    python tests/bench/bench_objects.py [--in-view 60] [--regions 20] [--repeats 30]

The scene is a row of rooms with a wall in the first one. Each room has `in-view` objects of 400
Gaussians. Then a keyframe observes the first room again, with `regions` of its objects detected.
All objects are computed again, as after a correction, and published. Times are CPU ms of this
thread, median and minimum. `assign_gaussians` of the same Gaussians is measured for comparison on a
busy machine. The search looks for a COCO class among the 1000 objects.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ldo_service.detection.vocabulary import COCO, Vocabulary
from ldo_service.gaussians.rows import aligned_rows
from ldo_service.geometry import Camera, se3
from ldo_service.maps.publisher import ObjectPublisher
from ldo_service.schemas import encode
from ldo_service.semantics.data_association import MapView
from ldo_service.semantics.gaussian_labels import fields, new_labels
from ldo_service.semantics.label_assignment import AssignmentConfig, Regions, assign_gaussians
from ldo_service.semantics.objects import Objects
from ldo_service.semantics.text_search import search

CAMERA, OBJECTS, EACH, WALL = Camera(640, 480, 520.0, 520.0, 319.5, 239.5), 1000, 400, 76_000
ROOM_M, AWAY_M = 20.0, 3.0


class Rooms:
    """Gaussians of the objects, one object after the other, and of the wall of the first room."""

    def __init__(self, in_view: int) -> None:
        rng, side = np.random.default_rng(0), int(np.ceil(np.sqrt(in_view)))
        room, place = np.divmod(np.arange(OBJECTS), in_view)
        px = (np.stack([place % side, place // side], axis=1) + 0.5) / side * [640, 480]
        px -= [CAMERA.cx, CAMERA.cy]
        centers = np.column_stack([px / CAMERA.fx * AWAY_M, np.full(OBJECTS, AWAY_M)])
        centers[:, 0] += ROOM_M * room
        size_m = 0.8 * AWAY_M * CAMERA.height / CAMERA.fy / side
        within = (rng.random((OBJECTS, EACH, 3)) - 0.5) * size_m
        wall = rng.uniform([-1.8, -1.35, AWAY_M], [1.8, 1.35, AWAY_M + 0.05], (WALL, 3))
        self.thing = np.append(np.repeat(np.arange(OBJECTS), EACH), np.full(WALL, -1))
        self.rows = aligned_rows(len(self.thing))
        self.rows[:, :3] = np.concatenate([(centers[:, None] + within).reshape(-1, 3), wall])
        self.rows[:, 3:6], self.rows[:, 6], self.rows[:, 10] = np.log(0.004), 1, 2
        self.labels = new_labels(len(self.rows))
        fields(self.labels)["ids"][:, 0] = np.where(self.thing >= 0, 2 + self.thing % 60, 0)
        fields(self.labels)["weights"][:, 0] = self.thing >= 0

    def view(self, room: int, regions: int, keyframe: int) -> MapView:
        T_map_camera = np.eye(4)
        T_map_camera[0, 3] = ROOM_M * room
        p = self.rows[:, :3] - T_map_camera[:3, 3]
        px = CAMERA.project(p)
        inside = np.all((px > 0) & (px < [639, 479]), axis=1)
        indices = np.flatnonzero(inside).astype(np.uint32)
        thing, px = self.thing[indices], px[indices]
        here = np.unique(thing[thing >= 0])[:regions]
        number = np.full(OBJECTS + 1, -1, np.int32)
        number[here] = np.arange(len(here))
        boxes = [[*px[thing == k].min(axis=0), *px[thing == k].max(axis=0)] for k in here]
        classes = np.stack([2 + here % 60] * 2, axis=1)
        return MapView(
            *(keyframe, CAMERA, T_map_camera, self.rows, self.labels, np.arange(len(self.rows))),
            *(np.zeros(len(self.rows), np.int32), indices, number[thing]),
            *(np.array(boxes), classes, np.full((480, 640), AWAY_M, np.float32)),
        )


def milliseconds(call: Callable[[int], object], repeats: int) -> str:
    times = []
    for number in range(repeats):
        start = time.thread_time()
        call(number)
        times.append(1e3 * (time.thread_time() - start))
    return f"{np.median(times):6.2f} {min(times):6.2f}"


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--in-view", type=int, default=60)
    parser.add_argument("--regions", type=int, default=20)
    parser.add_argument("--repeats", type=int, default=30)
    given = parser.parse_args()
    rooms, objects, keyframe = Rooms(given.in_view), Objects(), 0
    for room in range(-(-OBJECTS // given.in_view)):
        for _ in range(3):
            objects.observe(rooms.view(room, 64, keyframe))
            keyframe += 1
    view = rooms.view(0, given.regions, keyframe)
    print(f"{len(objects)} objects, {len(view.indices)} Gaussians in view; ms, median and minimum")
    depth, regions = view.depth_m, Regions.of_boxes(view.boxes, np.ones(len(view.boxes)))
    look = rooms.rows, view.indices, CAMERA, se3.inverse(view.T_map_camera), depth, regions
    print(
        "assign ",
        milliseconds(lambda _: assign_gaussians(*look, AssignmentConfig()), given.repeats),
    )

    def observe(number: int) -> None:
        objects.observe(replace(view, keyframe=keyframe + number))

    print("observe", milliseconds(observe, given.repeats))
    known = rooms.rows, rooms.labels, view.ids, view.anchors
    print("refresh", milliseconds(lambda _: objects.refresh(*known), given.repeats))
    names = Vocabulary().names
    duration = milliseconds(
        lambda _: encode(ObjectPublisher().message(objects, names, 0, 0, 0)), given.repeats
    )
    print("publish", duration)
    teller = ObjectPublisher()

    def observe_and_publish(number: int) -> None:
        observe(given.repeats + number)
        encode(teller.message(objects, names, 0, 0, 0))

    print("observe and publish", milliseconds(observe_and_publish, given.repeats))
    found = ObjectPublisher().message(objects, names, 0, 0, 0).objects
    print("search ", milliseconds(lambda n: search(COCO[n], _named(found)), given.repeats))


def _named(found: tuple) -> list[dict[str, float]]:
    return [dict(one.distribution) for one in found]


if __name__ == "__main__":
    main()
