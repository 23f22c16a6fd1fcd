"""Open-vocabulary labellers of image regions (paper, III.B).

Labeller      the interface that the actor uses
DualEncoder   dual_encoder.py: an image and a text encoder with one space, as in CLIP; ONNX
HttpLabeller  chat_completion.py: a vision-language model behind an OpenAI-compatible server
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

ScoredLabel = tuple[str, float]  # Label as in a vocabulary, and its probability, 0..1.


class Labeller(Protocol):
    """Labeller of image regions."""

    @property
    def identity(self) -> str:
        """Name and version of the labeller for records."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Names that it chooses from; empty: any name."""
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
        """Add a name to choose from.

        Raises:
            ConfigError: If that is not possible.
        """
        ...

    def metrics(self) -> dict[str, float]:
        """Return the counters of the labeller."""
        ...


def fused_over_views(views: Iterable[Iterable[ScoredLabel]]) -> list[ScoredLabel]:
    """Return the mean probability of each label over the views, the most probable first.

    A view without a label counts as probability 0. So two views that agree prevail over one with a
    high probability. Equal labels keep their order.

    >>> fused_over_views([[("cup", 0.75), ("vase", 0.25)], [("vase", 1.0)]])
    [('vase', 0.625), ('cup', 0.375)]
    """
    scored_labels = [tuple(view) for view in views]
    sums: dict[str, float] = defaultdict(float)
    for name, probability in (scored for view in scored_labels for scored in view):
        sums[name] += probability
    means = [(name, total / len(scored_labels)) for name, total in sums.items()]
    return sorted(means, key=lambda scored: -scored[1])
