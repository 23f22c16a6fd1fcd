"""Confirmation of Gaussians: each Gaussian must be visible in at least one keyframe image."""

from collections.abc import Sequence

import numpy as np

from .fitting import random_for
from .keyframe_store import KeyframeStore
from .pruning import PruningConfig
from .renderer import VisibleGaussians


class Confirmation:
    """Choice of the keyframes whose Gaussians are checked for visibility at each new keyframe.

    Args:
        store: Store of the keyframe images.
        config: Criteria; `confirm_keyframes` and `min_weight_px` are used.
        seed: Seed of the random choice of keyframes.
    """

    def __init__(self, store: KeyframeStore, config: PruningConfig, seed: int) -> None:
        self._store, self._config, self._seed = store, config, seed

    def start(self, newest: int, gaussians: int) -> "VisibilityCheck":
        """Start a check of the Gaussians of two keyframes.

        The first keyframe is the newest keyframe that has `confirm_keyframes` later keyframes. The
        second keyframe is drawn at random from the first one and all earlier keyframes, because the
        map around old keyframes also changes. The check is empty if there are too few keyframes, or
        if `min_weight_px` is 0.

        Args:
            newest: Id of the newest keyframe.
            gaussians: Number of Gaussians in memory.
        """
        age, min_px = self._config.confirm_keyframes, self._config.min_weight_px
        older = [k for k in self._store.keyframes() if k < newest][: 1 - age or None]
        chosen: set[int] = set()
        if older and min_px > 0:
            rng = random_for(self._seed, newest, 1)
            chosen = {older[-1], older[int(rng.integers(len(older)))]}
        return VisibilityCheck(newest, sorted(chosen), gaussians, min_px)


class VisibilityCheck:
    """Search for hidden Gaussians, by their blending weights in optimizer iterations.

    The Gaussian optimizer computes the weights anyway, so the check needs no extra renderings.
    Extra renderings took 6 % of the mapper's CPU time on the sequence kitchen.

    Args:
        newest: Id of the newest keyframe.
        keyframes: Older keyframes whose Gaussians are checked.
        gaussians: Number N of Gaussians, which must not change during the check.
        min_weight_px: Threshold for the sum of a Gaussian's blending weights over the pixels of an
            image. A Gaussian with a smaller sum is hidden in this image.

    Attributes:
        keyframes: Older keyframes whose Gaussians are checked.
    """

    def __init__(
        self, newest: int, keyframes: Sequence[int], gaussians: int, min_weight_px: float
    ) -> None:
        self.keyframes = keyframes
        self._newest, self._min_weight_px = newest, min_weight_px
        self._seen: set[int] = set()  # Keyframes on which at least one iteration ran.
        self._largest_px = np.zeros(gaussians, np.float32)

    def observe(self, keyframe: int, visible: VisibleGaussians) -> None:
        """Record how much each Gaussian contributed to the image in one iteration on a keyframe.

        Keyframes that are not part of the check are ignored.

        Args:
            keyframe: Keyframe of the iteration.
            visible: Visible Gaussians with the sums of their blending weights.
        """
        if keyframe == self._newest or keyframe in self.keyframes:
            self._seen.add(keyframe)
            before = self._largest_px[visible.indices]
            self._largest_px[visible.indices] = np.maximum(before, visible.weights)

    def hidden_mask(self, anchors: np.ndarray) -> np.ndarray:
        """Return the mask of the hidden Gaussians that are anchored to the checked keyframes.

        A Gaussian is hidden if its blending weights sum to less than `min_weight_px` in each
        iteration on the newest keyframe and on the checked keyframes. It does not count as hidden
        if its anchor keyframe or the newest keyframe had no iteration.

        Args:
            anchors: Anchor keyframe of each Gaussian, [N].

        Returns:
            Mask [N] bool.
        """
        known = [k for k in self.keyframes if k in self._seen] if self._newest in self._seen else []
        return np.isin(anchors, known) & (self._largest_px < self._min_weight_px)
