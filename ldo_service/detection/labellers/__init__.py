"""Open-vocabulary labellers of image regions (LDO-SLAM paper, III.B).

Labeller      interface of all labellers, which the actor vlm_labeller uses
DualEncoder   dual_encoder.py: image and text encoder with a common embedding space, as in CLIP;
              ONNX
HttpLabeller  chat_completion.py: vision-language model behind an OpenAI-compatible server
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

ScoredLabel = tuple[str, float]  # Canonical name, see `vocabulary`, and its probability, 0..1.


class Labeller(Protocol):
    """Interface of labellers, which give names to image regions."""

    @property
    def identity(self) -> str:
        """Name and version of the labeller, for recordings and logs."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names that the labeller chooses from; empty: it may return any name."""
        ...

    def label(self, crops: Sequence[np.ndarray]) -> list[ScoredLabel]:
        """Return the labels of a region, the most probable first.

        Args:
            crops: Views of the region, each [h, w, 3] uint8 RGB.

        Returns:
            The labels; empty if no name fits.

        Raises:
            ModelError: If the network fails.
            EndpointError: If the server fails.
        """
        ...

    def add(self, name: str) -> None:
        """Add a name to the list that the labeller chooses from.

        Raises:
            ConfigError: If the labeller cannot add this name.
        """
        ...

    def metrics(self) -> dict[str, float]:
        """Return the counters of the labeller."""
        ...


def fused_over_views(views: Iterable[Iterable[ScoredLabel]]) -> list[ScoredLabel]:
    """Return the mean probability of each label over the views, the most probable first.

    A view that does not have a label counts as probability 0 for this label. Two views that agree
    can therefore prevail over a single view with a high probability. Labels with equal means keep
    the order of their first appearance.

    >>> fused_over_views([[("cup", 0.75), ("vase", 0.25)], [("vase", 1.0)]])
    [('vase', 0.625), ('cup', 0.375)]
    """
    scored_labels = [tuple(view) for view in views]
    sums: dict[str, float] = defaultdict(float)
    for name, probability in (scored for view in scored_labels for scored in view):
        sums[name] += probability
    means = [(name, total / len(scored_labels)) for name, total in sums.items()]
    return sorted(means, key=lambda scored: -scored[1])
