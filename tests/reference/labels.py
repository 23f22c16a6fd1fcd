"""Reference implementations of `gaussian_labels.observe`: with slots, and with every label."""

from math import exp, log

import numpy as np

from ldo_service.semantics.gaussian_labels import (
    BACKGROUND,
    MISS,
    OTHER,
    SLOTS,
    LabelConfig,
    Observations,
    fields,
)


def observe_reference(labels: np.ndarray, seen: Observations, config: LabelConfig) -> None:
    """Update labels like `gaussian_labels.observe`, equal up to rounding."""
    rows = fields(labels)
    columns = (seen.indices, seen.labels, seen.confidences, seen.extents_m)
    for i, label, confidence, extent_m in zip(*columns, strict=True):
        row = rows[i]
        p = {int(s): float(w) for s, w in zip(row["ids"], row["weights"], strict=True) if w > 0}
        step = _step(row, _dense_entropy(p), bool(p), label, float(confidence), extent_m, config)
        p = {s: (1 - step) * w for s, w in p.items()}
        if label > BACKGROUND:
            p[int(label)] = p.get(int(label), 0.0) + step
        _write(row, _kept(p, int(label)))
        _count(row, label, extent_m, config)


def observe_dense(
    p: np.ndarray, labels: np.ndarray, seen: Observations, config: LabelConfig
) -> None:
    """Update distributions [N, C] that keep every label; `labels` holds the other fields."""
    rows = fields(labels)
    columns = (seen.indices, seen.labels, seen.confidences, seen.extents_m)
    for i, label, confidence, extent_m in zip(*columns, strict=True):
        heavy = {s: w for s, w in enumerate(p[i]) if w > 0 and s != BACKGROUND}
        entropy, row = _dense_entropy(heavy), rows[i]
        step = _step(row, entropy, bool(heavy), label, float(confidence), extent_m, config)
        p[i] *= 1 - step
        p[i, max(label, BACKGROUND)] += step
        _count(row, label, extent_m, config)
        if label == MISS and config.ema == "paper" and row["misses"] == 0:
            p[i] = np.eye(p.shape[1])[BACKGROUND]


def _dense_entropy(p: dict[int, float]) -> float:
    """Compute the entropy in nats of labels `p` and background, which has the rest."""
    rest = 1 - sum(p.values())
    return -sum(w * log(w) for w in (*p.values(), rest) if w > 0)


def _step(
    row: np.ndarray,
    entropy: float,
    has_label: bool,
    label: int,
    confidence: float,
    extent_m: float,
    config: LabelConfig,
) -> float:
    """Return the step a of p <- (1 - a) p + a onehot, and update the evidence of `row`."""
    if label < MISS or (label == MISS and config.ema == "paper"):
        return 0.0
    held = 1 - config.hold_back * exp(-2 * entropy) * (1 - confidence) if has_label else 1.0
    if config.ema == "paper":
        return held * (1 - config.keep)
    weight = held * confidence if label > MISS else config.miss_weight
    known_m = row["extent_mm"] / 1000 or config.usual_extent_m
    if weight == 0 or (label == MISS and known_m < extent_m):
        return 0.0
    row["evidence"] = config.keep * row["evidence"] + weight
    return float(weight / row["evidence"])


def _count(row: np.ndarray, label: int, extent_m: float, config: LabelConfig) -> None:
    """Update the misses and the extent of `row`."""
    if label > MISS:
        row["misses"], row["extent_mm"] = 0, min(int(np.float32(1000) * extent_m), 65535)
    elif label == MISS:
        row["misses"] = min(int(row["misses"]) + 1, 255)
        if config.ema == "paper" and row["misses"] >= config.miss_limit:
            row["weights"], row["evidence"], row["extent_mm"], row["misses"] = 0, 0, 0, 0


def _kept(p: dict[int, float], newest: int) -> dict[int, float]:
    """Keep at most SLOTS labels.

    The lightest labels give their weight to `other`; of equal weights the newest label does.
    """
    if len(p) <= SLOTS:
        return p
    p = dict(p)
    named = sorted((s for s in p if s != OTHER), key=lambda s: (p[s], s != newest))
    for s in named[: len(named) - SLOTS + 1]:
        p[OTHER] = p.get(OTHER, 0.0) + p.pop(s)
    return p


def _write(row: np.ndarray, p: dict[int, float]) -> None:
    """Write the labels `p` to the slots of `row`, heaviest first."""
    heaviest = sorted(p.items(), key=lambda item: -item[1]) + [(BACKGROUND, 0.0)] * SLOTS
    row["ids"], row["weights"] = zip(*heaviest[:SLOTS], strict=True)
