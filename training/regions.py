"""Region proposals of a frame, as the service computes them, with their ground-truth objects.

Many of the regions that a labeller receives show a piece of a wall or parts of two objects. A
network that was trained only on whole objects would give such regions the name of an object.
"""

from collections.abc import Iterator

import numpy as np
from wear import degrade

from ldo_service.geometry import Camera
from ldo_service.regions.geometric_segmentation import segment_geometry
from ldo_service.regions.region_proposals import RegionProposalConfig, regions_of_image
from ldo_service.synthetic.flat.render import FlatRendering
from ldo_service.synthetic.flat.sensor import measured_depth_m

# Settings for frames that are half as wide as the default settings expect.
TRIGGER = RegionProposalConfig(min_side_px=12)
BLUR_PX = 4.0  # Maximum motion blur of the color images.
NO_THING = -1  # Class of a region that shows no object.
OWN = 0.7  # A region shows an object that covers at least this fraction of the region's pixels.
# A region that shows a smaller fraction than this of the object's visible pixels is omitted.
SHOWN = 0.1


def regions(frame: FlatRendering, lens: Camera, rng: np.random.Generator) -> Iterator[tuple]:
    """Yield the region proposals of a frame, with the object that each of them shows.

    The proposals are computed from color and depth with simulated camera errors. Where the
    simulated camera measures no depth, the exact depth is used, because the service uses the depth
    of the map there.

    Args:
        frame: The exact frame.
        lens: Intrinsics.
        rng: Source of the errors.

    Yields:
        One tuple per region: class id, instance id, x0, y0, x1, y1, number of pixels. The box is in
        pixels from the corner of the first pixel. The number counts the region's pixels on the
        object. A region without an object has the class NO_THING, the instance 0, and the number of
        all its pixels. A region that shows only a small piece of its object is omitted.
    """
    sharp = np.floor(np.clip(frame.light, 0, 1) * 255 + 0.5).astype(np.uint8)
    measured_m = measured_depth_m(frame.depth_m, frame.light, lens.fx, rng)
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
