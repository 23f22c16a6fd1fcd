"""What detector and open-vocabulary labeller say together of a region (paper, III.B)."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from ldo_service.errors import ConfigError


@dataclass(frozen=True, slots=True)
class FusionConfig:
    rule: Literal["adaptive", "fixed", "detector"] = "adaptive"
    beta: float = 2.0  # III.B
    epsilon: float = 1e-6  # III.B
    fixed_alpha: float = 0.5  # of `fixed`, an ablation (IV.C)

    def __post_init__(self) -> None:
        if self.rule not in ("adaptive", "fixed", "detector"):
            raise ConfigError(f"rule={self.rule!r} must be 'adaptive', 'fixed' or 'detector'.")
        if not (self.beta > 0 and self.epsilon > 0 and 0 <= self.fixed_alpha <= 1):
            raise ConfigError(f"{self}: beta and epsilon positive, fixed_alpha in 0..1.")


@dataclass(frozen=True, eq=False, slots=True)
class Fused:
    """labels [V] int16; confidences [V] float32, SemConf; alpha [V] float32, the detector's part;
    by_detector [V] float32, alpha Conf_YOLO"""

    labels: np.ndarray
    confidences: np.ndarray
    alpha: np.ndarray
    by_detector: np.ndarray


def fused(
    detector_labels: np.ndarray,
    detector_confidences: np.ndarray,
    overlaps: np.ndarray,
    open_labels: np.ndarray,
    open_confidences: np.ndarray,
    config: FusionConfig,
) -> Fused:
    """Label and confidence of V Gaussians, or regions.

        r_YOLO = overlap Conf_YOLO,  r_VLM = Conf_VLM
        alpha = r_YOLO^beta / (r_YOLO^beta + r_VLM^beta + epsilon)
        SemConf = alpha Conf_YOLO + (1 - alpha) Conf_VLM

    detector_labels, open_labels            [V] int
    detector_confidences, open_confidences  [V], 0..1; 0: not invoked, or it found nothing
    overlaps                                [V], 0..1, IoU or coverage of region and Gaussian

    The label is the detector's if alpha Conf_YOLO >= (1 - alpha) Conf_VLM. Where the labeller was
    not invoked alpha is 1. `fixed` has the same alpha wherever it was; `detector` ignores it.

    A box of 0.8 over half of a splat, and a labeller that is 0.6 sure: r = 0.4 and 0.6,
    alpha = 0.16 / (0.16 + 0.36), SemConf = 0.308 * 0.8 + 0.692 * 0.6; 0.246 loses against 0.415:

    >>> one = fused(*np.array([[7], [0.8], [0.5], [9], [0.6]]), FusionConfig())
    >>> int(one.labels[0]), round(float(one.alpha[0]), 3), round(float(one.confidences[0]), 3)
    (9, 0.308, 0.662)
    """
    confidences = np.asarray(detector_confidences, np.float32)
    open_confidences = np.asarray(open_confidences, np.float32)
    invoked = (open_confidences > 0) & (config.rule != "detector")
    alpha = np.where(invoked, _alpha(overlaps * confidences, open_confidences, config), 1)
    alpha = alpha.astype(np.float32)
    by_detector, by_labeller = alpha * confidences, (1 - alpha) * open_confidences
    labels = np.where(by_detector >= by_labeller, detector_labels, open_labels)
    return Fused(labels.astype(np.int16), by_detector + by_labeller, alpha, by_detector)


def _alpha(r_detector: np.ndarray, r_open: np.ndarray, config: FusionConfig) -> np.ndarray:
    if config.rule != "adaptive":
        return np.full(r_open.shape, config.fixed_alpha)
    ours = r_detector.astype(float) ** config.beta
    return ours / (ours + r_open.astype(float) ** config.beta + config.epsilon)
