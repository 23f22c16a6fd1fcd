"""Median depth of a rendering, and the contributions of the Gaussians to it."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from . import contributions
from .arrays import Arrays
from .blending import ONE_WARP
from .plane_rendering import FOUR_WARPS, LANES, TILE, PlaneRendering, programs_for


@dataclass(frozen=True, eq=False, slots=True)
class ContributionArrays:
    """Contributions of the V drawn Gaussians to a rendering, on the device.

    Attributes:
        weights: Blending weights of the drawn Gaussians (`TileLists.visible`), summed over the
            pixels, [V]; 0 for hidden Gaussians.
        top: Row with the largest blending weight at each pixel, [H, W] int32; -1 if no row has any.
    """

    weights: Any
    top: Any


def median_depth(arrays: Arrays, rendering: PlaneRendering) -> Any:
    """Return the depth at which the transmittance falls below one half, [H, W], on the device.

    The depth is 0 where the transmittance stays higher.
    """
    lists = rendering.lists
    medians = arrays.empty((rendering.height, rendering.width), np.float32)
    contributions.median_depths[(len(lists.starts) - 1,)](
        rendering.splats.splats,
        lists.listed,
        lists.reached,
        lists.starts,
        -(-rendering.width // TILE),
        rendering.width,
        rendering.height,
        medians,
        **ONE_WARP,
    )
    return medians


def contributions_to(arrays: Arrays, rendering: PlaneRendering) -> ContributionArrays:
    """Return the contributions of the Gaussians to a rendering."""
    lists, n_visible = rendering.lists, len(rendering.lists.visible)
    by_pair = arrays.zeros((len(lists.listed),), np.float32)
    top = arrays.empty((rendering.height, rendering.width), np.int32)
    contributions.contribute[(len(lists.starts) - 1,)](
        rendering.splats.splats,
        lists.listed,
        lists.reached,
        lists.origins,
        lists.starts,
        rendering.ends,
        -(-rendering.width // TILE),
        rendering.width,
        rendering.height,
        by_pair,
        top,
        **ONE_WARP,
    )
    weights = arrays.empty((n_visible,), np.float32)
    if n_visible > 0:
        contributions.add_pairs[programs_for(n_visible, LANES)](
            by_pair,
            lists.visible,
            n_visible,
            lists.firsts,
            rendering.splats.pairs,
            weights,
            BLOCK=LANES,
            **FOUR_WARPS,
        )
    return ContributionArrays(weights, top)
