"""Export of the detector in the layout of YOLOv8: proposals, rescored by the image encoder.

Input:
    images: RGB [1, 3, 256, 320] in 0..1, with the frame in the center and gray around it.

Output:
    output0: Array [1, 4 + C, 1680] of cx, cy, w, h in pixels of the input, then the scores of the C
        classes of `cells.NAMES`.

The proposal network (`detector`) predicts boxes. The image encoder of the dual encoder classifies
the LOOKS most likely boxes again. The score of such a box is the class probability from both
networks times the predicted IoU of the box. All other boxes have score 0.

Two-step detectors (Ren et al., NeurIPS 2015) work in this way. Here, however, the second step is a
separate network. It is trained on crops, which takes far fewer training steps.
"""

from pathlib import Path

import detector
import jax
import numpy as np
from cells import CELL_COUNT, INPUT_PX, NAMES, THINGS
from crops import DEVIATION, MARGIN, MEAN, crop, enlarged
from crops import INPUT_PX as CROP_PX
from detector import FirstStage
from encoder import Pair, embedded
from layers import Graph
from onnx import TensorProto

LOOKS = 64  # Maximum number of rescored boxes.
DISTINCT_IOU = 0.7  # Maximum IoU of two rescored boxes.
# Weights of the logits of the proposal network and of the image encoder. They are below 1 because
# both networks see the same pixels. These values are the best on the calibration rooms.
FIRST_WEIGHT, SECOND_WEIGHT = 0.5, 0.6


def export(first: FirstStage, pair: Pair, scale: float, path: Path) -> None:
    """Write the detector as an ONNX file.

    Args:
        first: The proposal network.
        pair: The dual encoder. Its names do not include NO_NAME, the name of regions that
            show no object.
        scale: Calibrated factor on the cosines of the dual encoder's vectors.
        path: File to write.
    """
    graph = Graph(first.weights, first.statistics)
    # Proposals.
    corners, fit, logits = detector.looked(graph)
    fit = graph.node("Sigmoid", fit)
    cells = _best(graph, corners, fit, logits)
    boxes = graph.node("Gather", graph.node("Squeeze", corners, graph.integers(0)), cells, axis=0)
    # Rescoring.
    second = _second_logits(graph.beside(pair.weights, pair.statistics), boxes, pair, scale)
    # Scores from both.
    names = graph.node("Softmax", _joined(graph, _rows(graph, logits, cells), second), axis=1)
    names, _ = graph.split(names, (len(NAMES), len(THINGS) + 1 - len(NAMES)))
    scores = graph.node("Mul", names, _rows(graph, fit, cells))
    _write(graph, corners, cells, scores)
    shapes = (1, 3, INPUT_PX[1], INPUT_PX[0]), (1, 4 + len(NAMES), CELL_COUNT)
    about = {"names": str(dict(enumerate(NAMES))), "license": "Apache-2.0"}
    graph.save(path, ("images", shapes[0]), ("output0", shapes[1]), about)


def output(
    first: FirstStage, pair: Pair, scale: float, image: np.ndarray, is_chosen: np.ndarray
) -> np.ndarray:
    """Compute the detector's output in NumPy, as a reference for the exported graph.

    Args:
        first: The proposal network.
        pair: The dual encoder. Its names do not include NO_NAME, the name of regions that
            show no object.
        scale: Calibrated factor on the cosines of the dual encoder's vectors.
        image: Image [H, W, 3] uint8.
        is_chosen: Mask [N] of the cells to rescore.

    Returns:
        Array [N, 4 + C] with a row for each cell: cx, cy, w, h of its box in pixels, then the
        scores of the C classes.
    """
    corners, fit, logits = (part[0] for part in first.look(image[None]))
    cells = np.flatnonzero(is_chosen)
    parts = np.array([crop(image, enlarged(corners[cell], MARGIN)) for cell in cells])
    cosines = SECOND_WEIGHT * scale * pair.images(parts, with_mirror=False) @ pair.texts.T
    nothing = np.log(np.exp(cosines[:, len(THINGS) :]).sum(axis=1, keepdims=True))
    second = np.hstack((cosines[:, : len(THINGS)], nothing))
    names = jax.nn.softmax(FIRST_WEIGHT * logits[cells] + second)[:, : len(NAMES)]
    scores = np.zeros((len(corners), len(NAMES)))
    scores[cells] = names / (1 + np.exp(-fit[cells, None]))
    low, high = corners[:, :2], corners[:, 2:]
    return np.hstack(((low + high) / 2, high - low, scores))


def _best(graph: Graph, corners: str, fit: str, logits: str) -> str:
    """Add nodes that choose the cells with the most likely objects, by non-maximum suppression.

    Returns:
        Name of the tensor with the indices [K] of the cells, K <= LOOKS.
    """
    _, nothing = graph.split(graph.node("Softmax", logits, axis=1), (len(THINGS), 1))
    likely = graph.node("Mul", fit, graph.node("Sub", graph.number(1), nothing))
    most, iou = graph.integers(LOOKS), graph.constant(np.array([DISTINCT_IOU], np.float32))
    chosen = graph.node("NonMaxSuppression", corners, likely, most, iou)
    return graph.node("Gather", chosen, graph.constant(np.array(2, np.int64)), axis=1)


def _rows(graph: Graph, x: str, cells: str) -> str:
    """Return the name of a tensor [K, C]: the values of x [1, C, N] at the indices `cells` [K]."""
    rows = graph.node("Transpose", graph.node("Squeeze", x, graph.integers(0)), perm=[1, 0])
    return graph.node("Gather", rows, cells, axis=0)


def _second_logits(graph: Graph, boxes: str, pair: Pair, scale: float) -> str:
    """Return the name of the tensor of the dual encoder's logits [K, T + 1], background last."""
    # Mirror images would double the work for the many crops.
    images = embedded(graph, _crops(graph, boxes), with_mirror=False)
    cosines = graph.node("MatMul", images, graph.constant(SECOND_WEIGHT * scale * pair.texts.T))
    things, building = graph.split(cosines, (len(THINGS), len(pair.texts) - len(THINGS)))
    nothing = graph.node("ReduceLogSumExp", building, axes=[1], keepdims=1)
    return graph.node("Concat", things, nothing, axis=1)


def _joined(graph: Graph, first: str, second: str) -> str:
    return graph.node("Add", graph.node("Mul", first, graph.number(FIRST_WEIGHT)), second)


def _crops(graph: Graph, boxes: str) -> str:
    """Return the name of the tensor of normalized crops [K, 3, 64, 64] of boxes [K, 4].

    The crops are those of `crops.crop` and `crops.planes`, apart from the interpolation.
    """
    low, high = graph.split(boxes, (2, 2))
    margin = graph.node("Mul", graph.node("Sub", high, low), graph.number(MARGIN))
    low = graph.node("Max", graph.node("Sub", low, margin), graph.number(0))
    ends = graph.constant(np.array([INPUT_PX], np.float32))
    high = graph.node("Min", graph.node("Add", high, margin), ends)
    sides = graph.node("Max", graph.node("Sub", high, low), graph.number(1))
    half = graph.node("Mul", graph.node("ReduceMax", sides, axes=[1]), graph.number(0.5))
    middle = graph.node("Mul", graph.node("Add", low, high), graph.number(0.5))
    squares = graph.node(
        "Concat", graph.node("Sub", middle, half), graph.node("Add", middle, half), axis=1
    )
    mean, deviation = (graph.constant(part[None, :, None, None]) for part in (MEAN, DEVIATION))
    values = graph.node("Div", graph.node("Sub", "images", mean), deviation)
    form = {"output_height": CROP_PX, "output_width": CROP_PX, "sampling_ratio": 0}
    form |= {"coordinate_transformation_mode": "half_pixel", "mode": "avg"}
    taken = graph.node("RoiAlign", values, squares, _zeros(graph, half), **form)
    return _masked(graph, taken, graph.node("Div", sides, half))


def _zeros(graph: Graph, like: str) -> str:
    """Return the name of a tensor [K] of zeros: the index of the only image for each of K crops."""
    flat = graph.node("Squeeze", graph.node("Mul", like, graph.number(0)), graph.integers(1))
    return graph.node("Cast", flat, to=TensorProto.INT64)


def _masked(graph: Graph, crops: str, extents: str) -> str:
    """Set pixels outside the box to zero, which is CLIP's mean.

    Args:
        graph: The graph.
        crops: Crops [K, 3, 64, 64] of squares.
        extents: Width and height [K, 2] of the boxes; 2 is the side of the square.
    """
    places = np.abs((np.arange(CROP_PX) + 0.5) * 2 / CROP_PX - 1).astype(np.float32)
    shapes = (1, 1, 1, CROP_PX), (1, 1, CROP_PX, 1)
    extents = graph.node("Mul", extents, graph.number(0.5))
    for extent, shape in zip(graph.split(extents, (1, 1)), shapes, strict=True):
        extent = graph.node("Unsqueeze", extent, graph.integers(2, 3))
        is_inside = graph.node("Less", graph.constant(places.reshape(shape)), extent)
        crops = graph.node("Mul", crops, graph.node("Cast", is_inside, to=TensorProto.FLOAT))
    return crops


def _write(graph: Graph, corners: str, cells: str, scores: str) -> None:
    """Add `output0`: the boxes and scores of all cells; a cell that is not rescored has score 0."""
    empty = graph.constant(np.zeros((CELL_COUNT, len(NAMES)), np.float32))
    rows = graph.node("Unsqueeze", cells, graph.integers(1))
    scores = graph.node("ScatterND", empty, rows, scores)
    scores = graph.node("Transpose", scores, perm=[1, 0])
    scores = graph.node("Unsqueeze", scores, graph.integers(0))
    low, high = graph.split(graph.node("Transpose", corners, perm=[0, 2, 1]), (2, 2))
    centers = graph.node("Mul", graph.node("Add", low, high), graph.number(0.5))
    extents = graph.node("Sub", high, low)
    graph.node("Concat", centers, extents, scores, axis=1, output="output0")
