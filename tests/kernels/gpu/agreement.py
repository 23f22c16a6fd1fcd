"""Limits on the differences between GPU kernels, C++ kernels and reference implementations.

The summary of pytest lists the largest and the median difference of each kind.
"""

import numpy as np

LIMITS = {
    "planes to C++": 5e-7,  # Relative to the largest value of the plane.
    "planes to reference": 4e-6,
    "weights of Gaussians to C++": 5e-7,  # Relative to the largest weight.
    "weights of Gaussians to reference": 2e-6,
    "derivatives by rows to C++": 1e-5,  # Norms, for each group of columns.
    "derivatives by rows to reference": 2e-5,
    "C++ derivatives by rows to reference": 2e-5,
    "derivative by pose to C++": 2e-5,
    "derivative by pose to reference": 2e-5,
    "sums by pairs to reference": 2e-5,  # Norms, for each of the eleven sums.
    "sums by Gaussians to reference": 1e-6,
    "step of Adam to C++": 3e-7,
    "step of Adam to reference": 1e-6,
    "loss to C++": 2e-6,
    "loss to reference": 2e-6,
    "derivatives of loss to C++": 5e-6,
    "derivatives of loss to reference": 5e-6,
    "block means to OpenCV": 5e-7,
    "block means to reference": 5e-7,
    # The unit is the square root of the diagonal of the Hessian.
    "normal equations to C++": 1e-6,
    "normal equations to reference": 1e-5,
    "gradients by cell to C++": 1e-6,
    "gradients by cell to reference": 5e-6,
    # One iteration of the optimizer, from the same rows, moments and step counts.
    "exposure of an iteration to C++": 1e-6,
    "moments of an iteration to C++": 1e-5,
    "rows of an iteration to C++": 1e-6,
    # Ten iterations of the optimizer; the rows are compared by columns.
    "rows after ten iterations": 1e-2,
    "median of rows after ten iterations": 1e-5,
    "loss in ten iterations": 1e-4,
    "exposure after ten iterations": 1e-4,
    "motion of poses in ten iterations": 5e-6,
    "moments of poses in ten iterations": 2e-5,
}
measured: dict[str, list[tuple[float, str]]] = {}


def check(kind: str, error: float, where: str) -> None:
    """Record a difference, and fail if it is above the limit of its kind."""
    measured.setdefault(kind, []).append((float(error), where))
    assert error <= LIMITS[kind], f"{kind} in {where}: {error:.2e}, limit {LIMITS[kind]:.0e}"


def relative(got: np.ndarray, wanted: np.ndarray) -> float:
    """Return the norm of the difference, relative to the norm of `wanted` unless it is 0."""
    return float(np.linalg.norm(got - wanted) / (np.linalg.norm(wanted) or 1))


def peak(got: np.ndarray, wanted: np.ndarray) -> float:
    """Return the largest difference relative to the largest value."""
    if not wanted.size:
        return 0.0
    return float(np.abs(got - wanted).max() / max(np.abs(wanted).max(), 1e-30))


def summary() -> list[str]:
    """Return a line for each kind with its largest and median difference."""
    lines = []
    for kind, errors in measured.items():
        largest, where = max(errors)
        median = np.median([error for error, _ in errors])
        lines.append(f"{kind:38} {largest:.1e}, median {median:.1e} ({where})")
    return lines
