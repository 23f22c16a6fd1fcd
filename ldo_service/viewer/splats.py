"""Gaussians as a browser draws them."""

from dataclasses import dataclass

import numpy as np

from ldo_service.gaussians.pruning import _opacities
from ldo_service.geometry import se3


@dataclass(frozen=True, slots=True)
class Splats:
    """centers      [N, 3] float32, metres, map frame
    covariances  [N, 3, 3] float32, m^2
    colors       [N, 3] float32 RGB, 0..1
    opacities    [N, 1] float32, 0..1
    """

    centers: np.ndarray
    covariances: np.ndarray
    colors: np.ndarray
    opacities: np.ndarray


def splats_of(rows: np.ndarray) -> Splats:
    """Of Gaussian rows [N, 16] (see `gaussians.model`): the covariance is R S S R^T, with the
    rotation R of the quaternion and the scales S."""
    R, scales = se3.rotation(rows[:, 6:10]), np.exp(rows[:, 3:6])
    half = R * scales[:, None, :]  # R S
    return Splats(
        rows[:, 0:3],
        half @ half.transpose(0, 2, 1),
        np.clip(rows[:, 11:14], 0, 1),
        _opacities(rows)[:, None],
    )
