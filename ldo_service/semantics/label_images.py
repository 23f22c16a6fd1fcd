"""Images of labels: what the map says each pixel is."""

import numpy as np

from ldo_service.gaussians.model import aligned_rows
from ldo_service.gaussians.render import Rendering, render
from ldo_service.geometry import Camera

from .labels import BACKGROUND, background, fields, top_labels


def reliable_image(labels: np.ndarray, top: np.ndarray, least: float) -> np.ndarray:
    """[H, W] bool, where the Gaussian that made most of a pixel, `top` [H, W], has a label but
    background with that probability, or more."""
    rows = labels[np.maximum(top, 0).ravel()]
    is_named = (fields(rows)["weights"][:, 0] >= least) & (top_labels(rows) != BACKGROUND)
    return is_named.reshape(top.shape) & (top >= 0)


def label_image(
    rows: np.ndarray,
    labels: np.ndarray,
    shown: Rendering,
    camera: Camera,
    T_camera_map: np.ndarray,
    *,
    threads: int = 1,
) -> np.ndarray:
    """[H, W] uint8, per pixel the label s of the largest sum_i w_i p_i(s) over the Gaussians, of
    equals the lower number; background where there is none.

    Three labels a rendering, of the Gaussians that `shown` found to have made the image: for
    evaluation and pictures.
    """
    assert shown.contributions is not None
    made_by = shown.contributions.indices
    visible, said = aligned_rows(len(made_by)), labels[made_by]
    visible[:] = rows[made_by]
    records = fields(said)
    known = np.unique(records["ids"][records["weights"] > 0]).tolist()
    image = np.zeros((camera.height, camera.width), np.uint8)
    most = np.zeros(image.shape, np.float32)
    for three in (known[k : k + 3] for k in range(0, len(known), 3)):
        visible[:, 11:14] = 0
        for column, label in enumerate(three, 11):
            visible[:, column] = np.sum(records["weights"] * (records["ids"] == label), axis=1)
        sums = render(visible, camera, T_camera_map, threads=threads).color
        for channel, label in enumerate(three):
            image[sums[..., channel] > most] = label
            most = np.maximum(most, sums[..., channel])
    visible[:, 11:14] = background(said)[:, None]
    nothing = render(visible, camera, T_camera_map, threads=threads).color[..., 0]
    return np.where(nothing >= most, np.uint8(BACKGROUND), image)
