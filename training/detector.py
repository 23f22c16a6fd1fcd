"""Proposal network of the detector: every cell of three grids predicts the object that covers it.

Each cell predicts the name of its object, as in semantic segmentation. Each cell also predicts the
box of the object and the fit, which is the IoU of the predicted box with the true box. Every cell
has a training target in every frame, so few frames are enough for training. The network learns the
names of all synthetic objects, not only those in COCO.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from cells import BOXES_CELLS, INPUT_PX, STRIDES_PX, THINGS, grid
from layers import Graph, JaxNetwork, Statistics, Weights, merged, residual
from views import Views

import training
from examples import SMALL, batches

WIDE, TOLD_BY = 48, 64  # Number of channels of the neck and of each head.
RATE = 1e-2
BOX_WEIGHT, FIT_WEIGHT = 1.5, 1.0  # Weights relative to the cross entropy of the names.
TOLD = (4, 1, len(THINGS) + 1)  # Output channels: sides of the box, fit, names and background.


def network(net: JaxNetwork | Graph, image) -> list:
    """Compute the raw outputs of each grid, the finest first.

    Args:
        net: Backend of the network, see `layers`.
        image: Images [B, H, W, 3] in 0..1.

    Returns:
        For each grid, an array [B, rows, columns, 5 + T + 1]. Channels 0..3 are the distances from
        the center of the cell to the left, top, right and bottom side of the box, in cells, minus
        BOXES_CELLS. Channel 4 is the logit of the fit. The other channels are the logits of the T
        names in THINGS and of the background.
    """
    fine, middle, coarse = _trunk(net, image)
    return [
        _head(net, x, s) for x, s in zip(_neck(net, fine, middle, coarse), STRIDES_PX, strict=True)
    ]


def _trunk(net: JaxNetwork | Graph, image) -> tuple:
    """Return the features on each grid, finest first."""
    x = residual(net, merged(net, image, "stem", 32, side=4), "stage4", 32)
    fine = merged(net, x, "down8", 64)
    for k in range(2):
        fine = residual(net, fine, f"stage8.{k}", 64)
    middle = merged(net, fine, "down16", 96)
    for k in range(3):
        middle = residual(net, middle, f"stage16.{k}", 96)
    coarse = merged(net, middle, "down32", 128)
    for k in range(3):
        coarse = residual(net, coarse, f"stage32.{k}", 128)
    return fine, middle, coarse


def _neck(net: JaxNetwork | Graph, fine, middle, coarse) -> list:
    """Combine the features of all grids: pool the coarsest, then add coarse to finer features.

    The results are in the order of `_trunk`, with WIDE channels each.
    """
    x = net.conv(coarse, "pool.in", WIDE, size=1)
    wide = net.widest(x)
    c = net.conv(net.join([x, wide, net.widest(wide)]), "pool.out", WIDE, size=1)
    m = net.add(net.conv(middle, "side16", WIDE, size=1), net.enlarged(c))
    m = net.conv(m, "fuse16", WIDE)
    f = net.add(net.conv(fine, "side8", WIDE, size=1), net.enlarged(m))
    return [net.conv(f, "fuse8", WIDE), m, c]


def _head(net: JaxNetwork | Graph, x, stride_px: int):
    x = net.conv(x, f"told{stride_px}", TOLD_BY)
    return net.linear(x, f"tell{stride_px}", sum(TOLD))


def predicted(net: JaxNetwork, images):
    """Run the network on images, and join the outputs of all N cells.

    Args:
        net: Backend of the network.
        images: Images [B, H, W, 3] in 0..1.

    Returns:
        Boxes [B, N, 4] as x0, y0, x1, y1 in pixels, logits of the fit [B, N], and logits of the T
        names in THINGS and of the background [B, N, T + 1].
    """
    levels = network(net, images)
    flat = [level.reshape(level.shape[0], -1, level.shape[-1]) for level in levels]
    rows = jnp.concatenate(flat, axis=1)
    middles, sides = grid(images.shape[2:0:-1])
    reach = (rows[..., :4] + BOXES_CELLS) * sides
    corners = jnp.concatenate([middles - reach[..., :2], middles + reach[..., 2:]], -1)
    return corners, rows[..., 4], rows[..., 5:]


def loss(weights: Weights, batch: tuple):
    """Return the weighted sum of three losses: of the names, of the fit and of the boxes.

    The losses of names and fit are cross entropies. The loss of the boxes is the GIoU loss.

    Args:
        weights: Weights of the network.
        batch: Images [B, H, W, 3] uint8 and the targets of their cells: names [B, N], weights
            [B, N], boxes [B, N, 4] in pixels, and the mask [B, N] of cells that predict a box.
    """
    images, names, shares, boxes, tells_box = batch
    corners, fit, logits = predicted(JaxNetwork(weights), images.astype(jnp.float32) / 255)
    total = shares.sum()
    right = jnp.take_along_axis(jax.nn.log_softmax(logits), names[..., None], -1)[..., 0]
    iou, giou = overlaps(corners, boxes)
    truth = jax.lax.stop_gradient(iou) * tells_box
    fits = jnp.maximum(fit, 0) - fit * truth + jnp.log1p(jnp.exp(-jnp.abs(fit)))
    own = shares * tells_box
    misfit = (own * (1 - giou)).sum() / jnp.maximum(own.sum(), 1.0)
    return (shares * (FIT_WEIGHT * fits - right)).sum() / total + BOX_WEIGHT * misfit


def overlaps(a, b):
    """Calculate the IoU and the GIoU of boxes (Rezatofighi et al., CVPR 2019).

    Args:
        a: Boxes [..., 4], x0, y0, x1, y1.
        b: Boxes [..., 4].

    Returns:
        IoU [...] and GIoU [...].
    """
    low, high = jnp.maximum(a[..., :2], b[..., :2]), jnp.minimum(a[..., 2:], b[..., 2:])
    common = jnp.maximum(high - low, 0).prod(-1)
    union = jnp.maximum(_area(a) + _area(b) - common, 1e-6)
    low, high = jnp.minimum(a[..., :2], b[..., :2]), jnp.maximum(a[..., 2:], b[..., 2:])
    hull = jnp.maximum((high - low).prod(-1), 1e-6)
    return common / union, common / union - (hull - union) / hull


def _area(boxes):
    return jnp.maximum(boxes[..., 2:] - boxes[..., :2], 0).prod(-1)


@dataclass(frozen=True, slots=True)
class FirstStage:
    """Trained proposal network."""

    weights: Weights
    statistics: Statistics  # Means and variances of the normalized layers.

    def look(self, images: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return the results of `predicted` for images [B, H, W, 3] uint8."""
        live = JaxNetwork(self.weights, self.statistics)
        told = predicted(live, jnp.asarray(images, jnp.float32) / 255)
        return tuple(map(np.asarray, told))


def train(material: Views, steps: Sequence[int], seed: int) -> FirstStage:
    """Train the proposal network.

    Args:
        material: Training frames.
        steps: Number of training steps of each of the two rounds.
        seed: Seed of weights and batches.
    """
    rng = np.random.default_rng([seed, 1])
    live = JaxNetwork({}, rng=rng)
    network(live, jnp.zeros((1, *INPUT_PX[::-1], 3)))
    rounds = [batches(material, rng, SMALL), batches(material, np.random.default_rng([seed, 6]))]
    learned = training.fit_in_rounds(loss, live.weights, rounds, steps, RATE)
    rng = np.random.default_rng([seed, 4])
    images = (batch[0].astype(np.float32) / 255 for batch in batches(material, rng))
    return FirstStage(learned, training.statistics(network, learned, images))


def looked(graph: Graph) -> tuple[str, str, str]:
    """Add the proposal network to an ONNX graph whose input is `images`.

    Returns:
        Names of three tensors: boxes [1, N, 4] as x0, y0, x1, y1 in pixels, logits of the fit
        [1, 1, N], and logits of the T names in THINGS and of the background [1, T + 1, N].
    """
    rows = [
        graph.node("Reshape", level, graph.integers(1, sum(TOLD), -1))
        for level in network(graph, "images")
    ]
    raw = graph.node("Concat", *rows, axis=2)
    before, after, fit, logits = graph.split(raw, (2, 2, *TOLD[1:]))
    middles, sides = (graph.constant(part.T[None].copy()) for part in grid())
    start = graph.number(BOXES_CELLS)
    before, after = (
        graph.node("Mul", graph.node("Add", part, start), sides) for part in (before, after)
    )
    low, high = graph.node("Sub", middles, before), graph.node("Add", middles, after)
    corners = graph.node("Concat", low, high, axis=1)
    return graph.node("Transpose", corners, perm=[0, 2, 1]), fit, logits
