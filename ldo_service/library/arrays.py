"""Checks of the arrays that callers pass, and read-only arrays for results."""

from typing import Any

import numpy as np

from ldo_service.datasets.files import is_rigid
from ldo_service.errors import FrameError, LdoError
from ldo_service.geometry import Trajectory, se3

FrameArray = Any  # An array that supports DLPack or the buffer protocol.


def array_of(name: str, value: FrameArray) -> np.ndarray:
    """Convert an array of the caller into a NumPy array, without a copy if possible.

    Raises:
        FrameError: The value is no array, or lies in the memory of a GPU.
    """
    try:
        if isinstance(value, np.ndarray):
            return value
        if hasattr(value, "__dlpack__"):
            return np.from_dlpack(value)
        if not isinstance(value, (list, tuple)):
            array = np.asarray(value)
            if array.ndim:
                return array
    except (BufferError, RuntimeError, TypeError, ValueError) as error:
        raise FrameError(
            f"{name} is a {type(value).__name__} that cannot be read as an array: {error}. Give a "
            "NumPy array, or a tensor on the CPU without gradient."
        ) from error
    raise FrameError(
        f"{name} is a {type(value).__name__}, must be an array, such as numpy.ndarray or a tensor "
        "on the CPU."
    )


def read_only(trajectory: Trajectory) -> Trajectory:
    """Make the arrays of a trajectory read-only, and return the trajectory."""
    read_only_array(trajectory.stamps_s)
    read_only_array(trajectory.T_world_camera)
    return trajectory


def read_only_array(array: np.ndarray) -> np.ndarray:
    """Make an array read-only, and return it."""
    array.flags.writeable = False
    return array


def rigid_transform(name: str, value: object, error: type[LdoError]) -> np.ndarray:
    """Check a transform that a caller passed, and return it as [4, 4] float64.

    Args:
        name: Name of the checked argument, for the error text.
        value: Value of the checked argument.
        error: Type of the error to raise.

    Raises:
        LdoError: The value is not a rigid transform; the error has the type `error`.
    """
    try:
        T = np.asarray(value, float)
    except (TypeError, ValueError) as cause:
        raise error(f"{name} is a {type(value).__name__}, must be an array [4, 4].") from cause
    if T.shape != (4, 4):
        raise error(f"{name} has the shape {T.shape}, must have the shape (4, 4).")
    if not is_rigid(T):
        raise error(
            f"{name} is not a rigid transform: it must be finite, its rotation orthonormal without "
            "a reflection, and its last row 0 0 0 1."
        )
    return se3.orthonormalize(T)
