"""Confirmation of Gaussians: each must be visible in the image of at least one keyframe."""

import numpy as np

from .fitting import random_for
from .keyframe_renderer import KeyframeRenderer
from .keyframe_store import KeyframeStore
from .model import GaussianMap
from .pruning import PruningConfig


class Confirmation:
    """Search for hidden Gaussians, among the Gaussians that are anchored to two keyframes per call.

    Args:
        store: Store of the keyframe images.
        renderer: Renderer of the map at these keyframes.
        config: Criteria; `confirm_keyframes` and `min_weight_px` are used.
        seed: Seed of the random choice of keyframes.
    """

    def __init__(
        self, store: KeyframeStore, renderer: KeyframeRenderer, config: PruningConfig, seed: int
    ) -> None:
        self._store, self._renderer = store, renderer
        self._config, self._seed = config, seed

    def hidden_mask(self, gaussians: GaussianMap, newest: int) -> np.ndarray:
        """Return the mask of the hidden Gaussians that are anchored to either of two keyframes.

        The first keyframe is the newest one that has `confirm_keyframes` later keyframes. The
        second one is drawn at random from the first one and all earlier keyframes, since the map
        around old keyframes also changes. The map is rendered at these two keyframes and at the
        newest one. A Gaussian is hidden if its blending weights sum to less than `min_weight_px` in
        each of these images.

        Args:
            gaussians: The map.
            newest: Id of the newest keyframe.

        Returns:
            Mask [N] bool. All False while there are too few keyframes, or if `min_weight_px` is 0.
        """
        age, min_px = self._config.confirm_keyframes, self._config.min_weight_px
        older = [k for k in self._store.keyframes() if k < newest][: 1 - age or None]
        if not older or min_px == 0:
            return np.zeros(len(gaussians), bool)
        rng = random_for(self._seed, newest, 1)
        chosen = {older[-1], older[int(rng.integers(len(older)))]}
        shown = np.zeros(len(gaussians), np.float32)
        for keyframe in (newest, *sorted(chosen)):
            made_by = self._renderer.contributions(gaussians, keyframe)
            shown[made_by.indices] = np.maximum(shown[made_by.indices], made_by.weights)
        return np.isin(gaussians.anchors, list(chosen)) & (shown < min_px)
