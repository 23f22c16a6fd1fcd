"""The mapper's map as messages of a bounded size; `replica` puts them together again."""

from collections.abc import Iterable, Iterator

import numpy as np

from ldo_service.gaussians.change_log import Changes
from ldo_service.gaussians.model import ROW, GaussianBatch, new_labels
from ldo_service.schemas import Array, Gaussians

NO_IDS = np.zeros(0, np.int64)
NOTHING = GaussianBatch(
    NO_IDS, np.zeros((0, ROW), np.float32), np.zeros(0, np.int32), new_labels(0)
)


def gaussians_message(piece: GaussianBatch) -> Gaussians:
    """Without labels where nobody has seen any of them."""
    labels = piece.labels if piece.labels.any() else new_labels(0)
    return Gaussians(
        ids=Array.of(piece.ids),
        params=Array.of(piece.rows),
        anchors=Array.of(piece.anchors),
        labels=Array.of(labels),
    )


NO_GAUSSIANS = gaussians_message(NOTHING)


def piece_of(message: Gaussians) -> GaussianBatch:
    """Its arrays are read-only views, but for labels that did not travel."""
    ids, labels = message.ids.numpy(), message.labels.numpy()
    labels = labels if len(labels) else new_labels(len(ids))
    return GaussianBatch(ids, message.params.numpy(), message.anchors.numpy(), labels)


def rechunk(pieces: Iterable[GaussianBatch], parts: int, size: int) -> Iterator[Gaussians]:
    """Pieces as `parts` messages of `size` Gaussians, the last ones of what is left."""
    waiting, made = NOTHING, 0
    for piece in pieces:
        waiting = GaussianBatch(*map(np.concatenate, zip(waiting, piece, strict=True)))
        while len(waiting.ids) >= size and made < parts - 1:
            yield gaussians_message(waiting.at(slice(size)))
            waiting = waiting.at(slice(size, None))
            made += 1
    for _ in range(made, parts):
        yield gaussians_message(waiting.at(slice(size)))
        waiting = waiting.at(slice(size, None))


def split_changes(changes: Changes, size: int) -> Iterator[Changes]:
    """The same in pieces of at most `size` Gaussians: first what goes, then what changed, then
    what came. Nothing for no change."""
    if len(changes.removed):
        yield Changes(changes.removed, NO_IDS, NO_IDS)
    for start in range(0, len(changes.changed), size):
        yield Changes(NO_IDS, changes.changed[start : start + size], NO_IDS)
    for start in range(0, len(changes.added), size):
        yield Changes(NO_IDS, NO_IDS, changes.added[start : start + size])
