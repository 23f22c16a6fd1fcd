"""Frames of the sequence `synthetic:flat`, used only for the final scores."""

import numpy as np
import views
from views import VisibleBoxes

from ldo_service.synthetic.flat import FlatSequence


def flat_frames(stride: int) -> tuple[list[np.ndarray], VisibleBoxes]:
    """Return every `stride`-th frame of `synthetic:flat`, and the visible objects of these frames.

    The frames are [H, W, 3] uint8 RGB, with the errors of the simulated camera.
    """
    sequence = FlatSequence.named("flat")
    indices = range(0, len(sequence), stride)
    planes = [sequence.labels(index) for index in indices]
    seen = views.seen_in([(plane.class_ids, plane.instance_ids) for plane in planes])
    return [sequence.read(index).color for index in indices], seen
