"""Names for image regions from an open vocabulary (paper, III.B).

Labeller      what the actor needs of one
DualEncoder   dual_encoder.py: image and text meet in one space, as in CLIP; ONNX
HttpLabeller  http_labeller.py: a vision-language model behind an OpenAI-compatible server
"""

from collections import defaultdict
from collections.abc import Iterable, Sequence
from typing import Protocol

import numpy as np

Opinion = tuple[str, float]  # name as a vocabulary has it, and its probability 0..1


class Labeller(Protocol):
    @property
    def identity(self) -> str:
        """Which one it is, for the record."""
        ...

    @property
    def names(self) -> tuple[str, ...]:
        """Those that it chooses from; empty: any."""
        ...

    def label(self, crops: Sequence[np.ndarray]) -> list[Opinion]:
        """What one region is, the most probable first.

        crops  views of it, each [h, w, 3] uint8 RGB
        Empty when it has no opinion. Raises ModelError or EndpointError when it cannot look.
        """
        ...

    def add(self, name: str) -> None:
        """Choose from this name too, from now on. Raises ConfigError when it cannot."""
        ...

    def metrics(self) -> dict[str, float]:
        """What it counts."""
        ...


def fused_over_views(views: Iterable[Iterable[Opinion]]) -> list[Opinion]:
    """Mean over the views of each name's probability, the most probable first.

    A view that does not speak of a name gives it nothing, so two views that agree outdo one that is
    sure. Equal ones stay in the order in which they were named.

    >>> fused_over_views([[("cup", 0.75), ("vase", 0.25)], [("vase", 1.0)]])
    [('vase', 0.625), ('cup', 0.375)]
    """
    opinions = [tuple(view) for view in views]
    sums: dict[str, float] = defaultdict(float)
    for name, probability in (opinion for view in opinions for opinion in view):
        sums[name] += probability
    means = [(name, total / len(opinions)) for name, total in sums.items()]
    return sorted(means, key=lambda opinion: -opinion[1])
