"""Gradient descent: Muon with a rate that warms up and fades out in a line.

The step of a kernel is its momentum with all singular values made alike (Jordan et al., Muon,
2024), of the size that Adam's would have (Liu et al., Muon is scalable, 2025); of each tap of a
convolution by itself, which takes half the time and learns as much. Of crops of rooms kept apart
33 % are named right after 1000 steps of Adam, 41 % after as many of this. What is no kernel goes by
Adam.
"""

import logging
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from itertools import islice
from queue import Queue
from threading import Thread

import jax
import numpy as np
import optax
from layers import JaxNetwork, Statistics, Weights
from optax.contrib import MuonDimensionNumbers, muon

log = logging.getLogger(__name__)

WARM_UP_STEPS = 150
FALL = 0.4  # of all steps, at the end
ROUND_RATES = (1.0, 0.5)  # shares of the rate
NEWTON_SCHULZ_STEPS = 3  # with the better start of Grishina et al., 2025, as good as 5
ADAM_RMS = 0.2  # of its usual steps
DECAY = 0.02  # of weights, times the rate
MAX_STEP = 10.0  # norm of a gradient
REPORT_STEPS = 100
MEAN_STEPS = 200  # that the weights are averaged over, about
STATISTICS_BATCHES = 24  # that the normalisation's means and variances are taken over


def fit_in_rounds(
    loss: Callable, weights: Weights, batches: list[Iterable], steps: Sequence[int], rate: float
) -> Weights:
    """One fit after the other, each with batches, steps and a share of the rate of its own.

    A rate that rises anew leaves what the last round settled on, and finds better: Loshchilov and
    Hutter, SGDR, ICLR 2017.
    """
    for source, count, share in zip(batches, steps, ROUND_RATES, strict=True):
        weights = fit(loss, weights, source, count, share * rate)
    return weights


def fit(loss: Callable, weights: Weights, batches: Iterable, steps: int, rate: float) -> Weights:
    """The running mean of weights after one step of descent of `loss(weights, batch)` a batch."""
    descent = optax.chain(
        optax.clip_by_global_norm(MAX_STEP),
        muon(
            -1.0,  # the rate comes later: up the gradient until then
            ns_steps=NEWTON_SCHULZ_STEPS,
            preconditioning="schatten",
            consistent_rms=ADAM_RMS,
            muon_weight_dimension_numbers=_taps(weights),
        ),
        optax.add_decayed_weights(DECAY, mask=_is_kernel),
    )

    @jax.jit
    def step(weights, mean, state, batch, rate, share):
        value, gradient = jax.value_and_grad(loss)(weights, batch)
        change, state = descent.update(gradient, state, weights)
        weights = jax.tree.map(lambda w, c: w - rate * c, weights, change)
        mean = jax.tree.map(lambda m, w: m + share * (w - m), mean, weights)
        return weights, mean, state, value

    state, values, started = descent.init(weights), [], time.monotonic()
    mean = weights
    for number, batch in enumerate(ahead(islice(batches, steps)), 1):
        share = max(1 / number, 1 / MEAN_STEPS)
        now = rate * pace(number, steps)
        weights, mean, state, value = step(weights, mean, state, batch, now, share)
        values.append(float(value))
        if number % REPORT_STEPS == 0 or number == steps:
            recent, seconds = np.mean(values[-REPORT_STEPS:]), time.monotonic() - started
            log.info("step %d of %d: loss %.4f, %.0f s", number, steps, recent, seconds)
    return {name: np.asarray(value) for name, value in mean.items()}


def pace(number: int, steps: int) -> float:
    """Of the full rate at a step from 1: rising, level for most of the time, falling.

    What is learned until the fall does not depend on when that begins (Hu et al., MiniCPM, 2024).
    """
    rise, fall = number / WARM_UP_STEPS, (steps - number + 1) / (FALL * steps)
    return min(1.0, rise, fall)


def statistics(
    network: Callable[[JaxNetwork, np.ndarray], object], weights: Weights, inputs: Iterable
) -> Statistics:
    """Mean and variance of each normalised layer over some batches, for use after training."""

    @jax.jit
    def observe(batch):
        live = JaxNetwork(weights)
        network(live, batch)
        return live.observed

    few = islice(inputs, STATISTICS_BATCHES)
    observed = [jax.device_get(observe(batch)) for batch in few]
    return {
        name: tuple(np.mean([one[name][part] for one in observed], axis=0) for part in (0, 1))
        for name in observed[0]
    }


def ahead(batches: Iterable) -> Iterator:
    """The batches, made by a thread while the last ones are learned from."""
    queue: Queue = Queue(maxsize=4)

    def fill() -> None:
        for batch in batches:
            queue.put(batch)
        queue.put(None)

    Thread(target=fill, daemon=True).start()
    while (batch := queue.get()) is not None:
        yield batch


def _taps(weights: Weights) -> dict[str, MuonDimensionNumbers | None]:
    """Which axes make a matrix of a kernel [h, w, inputs, outputs]."""
    tap = MuonDimensionNumbers(2, 3)
    return {name: tap if weight.ndim == 4 else None for name, weight in weights.items()}


def _is_kernel(weights: Weights) -> dict[str, bool]:
    return {name: name.endswith("kernel") for name in weights}
