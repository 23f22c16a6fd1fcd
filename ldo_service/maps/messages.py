"""Conversion of Gaussians to map messages of bounded size, and back.

The module `replica` builds a copy of the map from these messages.
"""

from collections.abc import Iterable, Iterator

import numpy as np

from ldo_service.gaussians.change_log import Changes
from ldo_service.gaussians.model import GaussianBatch, new_labels
from ldo_service.gaussians.rows import ROW
from ldo_service.schemas import Array, Gaussians

NO_IDS = np.zeros(0, np.int64)
NOTHING = GaussianBatch(
    NO_IDS, np.zeros((0, ROW), np.float32), np.zeros(0, np.int32), new_labels(0)
)


def gaussians_message(batch: GaussianBatch) -> Gaussians:
    """Convert a batch of Gaussians to a message, without labels if no class was observed."""
    labels = batch.labels if batch.labels.any() else new_labels(0)
    return Gaussians(
        ids=Array.of(batch.ids),
        params=Array.of(batch.rows),
        anchors=Array.of(batch.anchors),
        labels=Array.of(labels),
    )


NO_GAUSSIANS = gaussians_message(NOTHING)


def batch_of(message: Gaussians) -> GaussianBatch:
    """Convert a message to a batch of Gaussians.

    The arrays of the batch are read-only views of the message. If the message has no labels, the
    batch gets a new array of labels, in which no class was observed.
    """
    ids, labels = message.ids.numpy(), message.labels.numpy()
    labels = labels if len(labels) else new_labels(len(ids))
    return GaussianBatch(ids, message.params.numpy(), message.anchors.numpy(), labels)


def rechunk(batches: Iterable[GaussianBatch], parts: int, size: int) -> Iterator[Gaussians]:
    """Regroup batches into exactly `parts` messages of at most `size` Gaussians.

    The messages are filled in order, so the last ones may have fewer Gaussians or none.
    """
    waiting, made = NOTHING, 0
    for batch in batches:
        waiting = GaussianBatch(*map(np.concatenate, zip(waiting, batch, strict=True)))
        while len(waiting.ids) >= size and made < parts - 1:
            yield gaussians_message(waiting.at(slice(size)))
            waiting = waiting.at(slice(size, None))
            made += 1
    for _ in range(made, parts):
        yield gaussians_message(waiting.at(slice(size)))
        waiting = waiting.at(slice(size, None))


def split_changes(changes: Changes, size: int) -> Iterator[Changes]:
    """Divide changes of the map into parts of at most `size` changed or added Gaussians.

    The first part has the ids of all removed Gaussians, which may be more than `size`. The
    next parts have the changed Gaussians, and the last parts have the added Gaussians. Empty parts
    are omitted.
    """
    if len(changes.removed):
        yield Changes(changes.removed, NO_IDS, NO_IDS)
    for start in range(0, len(changes.changed), size):
        yield Changes(NO_IDS, changes.changed[start : start + size], NO_IDS)
    for start in range(0, len(changes.added), size):
        yield Changes(NO_IDS, NO_IDS, changes.added[start : start + size])
