"""Regions of a frame as the service sets them apart, and what they are.

Who has seen whole things alone takes a piece of a wall for one, or two halves of things; and of the
regions that a labeller is asked about, many are just that.
"""

from collections.abc import Iterator

import numpy as np
from wear import degrade

from ldo_service.geometry import Camera
from ldo_service.regions.geometric_segmentation import segment_geometry
from ldo_service.regions.region_proposals import RegionProposalConfig, regions_of_image
from ldo_service.synthetic.flat.render import FlatRendering
from ldo_service.synthetic.flat.sensor import measured_depth_m

# of frames half as wide as those that it is made for
TRIGGER = RegionProposalConfig(min_side_px=12)
BLUR_PX = 4.0
NO_THING = -1  # in place of a class
OWN = 0.7  # share of a region that one thing has, to be that thing
SHOWN = 0.1  # share of what is seen of the thing: a smaller piece shows nobody what it is


def regions(frame: FlatRendering, lens: Camera, rng: np.random.Generator) -> Iterator[tuple]:
    """Class, instance, box and pixels of the thing, of each region that shows one, or no thing. By
    colors and depth as a camera measures them; where it measures none, depth is exact, as a map has
    it."""
    sharp = np.floor(np.clip(frame.light, 0, 1) * 255 + 0.5).astype(np.uint8)
    measured_m = measured_depth_m(frame, lens.fx, rng)
    depth_m = np.where(measured_m > 0, measured_m, frame.depth_m).astype(np.float32)
    shown = segment_geometry(degrade(sharp, rng, BLUR_PX), depth_m, lens, TRIGGER.segments)
    visible_px = np.bincount(frame.instance_ids.ravel())
    for region in regions_of_image(shown, depth_m.shape, TRIGGER):
        own = frame.instance_ids[region.part.image(depth_m.shape)]
        if len(own) == 0:
            continue
        counts = np.bincount(own, minlength=len(visible_px))
        instance = 1 + int(counts[1:].argmax()) if len(counts) > 1 else 0
        box_px = (*(region.box_px + 0.5),)
        if not instance or counts[instance] < OWN * len(own):
            yield NO_THING, 0, *box_px, len(own)
        elif counts[instance] >= SHOWN * visible_px[instance]:
            class_id = frame.class_ids[frame.instance_ids == instance][0]
            yield class_id, instance, *box_px, counts[instance]
