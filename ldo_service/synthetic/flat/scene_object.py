"""Object of the flat: its class and its solids.

The list of classes starts with those of COCO in their usual order. Other classes of objects follow,
then the parts of the building.
"""

from dataclasses import dataclass, replace

import numpy as np

from ldo_service.synthetic.solids import Solid

# Classes of COCO (Lin et al., ECCV 2014), with the ids 0-79 that detectors use.
COCO = (
    "person bicycle car motorcycle airplane bus train truck boat traffic_light fire_hydrant "
    "stop_sign parking_meter bench bird cat dog horse sheep cow elephant bear zebra giraffe "
    "backpack umbrella handbag tie suitcase frisbee skis snowboard sports_ball kite baseball_bat "
    "baseball_glove skateboard surfboard tennis_racket bottle wine_glass cup fork knife spoon bowl "
    "banana apple sandwich orange broccoli carrot hot_dog pizza donut cake chair couch "
    "potted_plant bed dining_table toilet tv laptop mouse remote keyboard cell_phone microwave "
    "oven toaster sink refrigerator book clock vase scissors teddy_bear hair_drier toothbrush"
)
OTHERS = (
    "fire_extinguisher whiteboard projector radiator ladder broom bucket cardboard_box lamp shelf "
    "door picture_frame toolbox speaker printer cabinet rug trash_can window coat_rack globe "
    "cushion fan"
)
BUILDING = "wall floor ceiling"

CLASS_NAMES = tuple(name.replace("_", " ") for name in f"{COCO} {OTHERS} {BUILDING}".split())
COCO_COUNT = len(COCO.split())
WALL, FLOOR, CEILING = (CLASS_NAMES.index(name) for name in BUILDING.split())


Heading = tuple[float, float]


@dataclass(frozen=True, slots=True)
class Placement:
    """Pose of an upright frame in an outer frame, z up in both."""

    origin_m: tuple[float, float, float]  # Origin in the outer frame.
    # x axis of the upright frame as a unit vector (x, y) in the outer frame.
    heading: Heading = (1.0, 0.0)

    def __call__(self, solid: Solid) -> Solid:
        """Transform a solid from the upright frame to the outer frame."""
        (x, y, z), (px, py, pz) = solid.center_m, self.origin_m
        (c, s), (hx, hy) = self.heading, solid.heading
        center_m = (px + (c * x - s * y), py + (s * x + c * y), pz + z)
        return replace(solid, center_m=center_m, heading=(c * hx - s * hy, s * hx + c * hy))


@dataclass(frozen=True, slots=True)
class SceneObject:
    """Class name and solids of one object, in the frame of the object, its room or the world."""

    label: str
    solids: tuple[Solid, ...]

    @property
    def bounds_m(self) -> tuple[np.ndarray, np.ndarray]:
        """Center [3] and size [3], meters, of the box around `solids`, in their common frame."""
        corners = np.concatenate([solid.corners_m() for solid in self.solids])
        low, high = corners.min(axis=0), corners.max(axis=0)
        return (low + high) / 2, high - low
