"""Intrinsics written as JSON."""

import json
from dataclasses import dataclass
from math import isfinite
from pathlib import Path
from typing import Any

from ldo_service.errors import DataError
from ldo_service.geometry import Camera


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera and the units of its stored depth per metre."""

    camera: Camera
    depth_scale: float

    def __post_init__(self) -> None:
        if not (isfinite(self.depth_scale) and self.depth_scale > 0):
            raise DataError(
                f"depth scale {self.depth_scale}: expected the positive number of depth units "
                "per metre, such as 5000 (TUM) or 1000 (millimetres)."
            )


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file. Raises DataError."""
    try:
        content = json.loads(path.read_text())
    except (OSError, ValueError, RecursionError) as error:
        raise DataError(f"{path} cannot be read as JSON: {error}.") from error
    if not isinstance(content, dict):
        raise DataError(f"{path} holds a {type(content).__name__}, expected a JSON object.")
    return content


def number(fields: dict[str, Any], key: str, path: Path) -> float:
    """The number under `key`. Raises DataError naming file and key."""
    value = fields.get(key)
    if isinstance(value, bool) or not isinstance(value, int | float) or not isfinite(value):
        found = "it is missing" if key not in fields else f"it is {value!r}"
        raise DataError(f'{path}: expected a finite number under "{key}", but {found}.')
    return float(value)


def pinhole(fields: dict[str, Any], width: str, height: str, path: Path) -> Camera:
    """The camera under fx, fy, cx, cy, `width`, `height` and optional distortion."""
    distortion = fields.get("distortion", [])
    if not isinstance(distortion, list):
        raise DataError(f'{path}: "distortion" is {distortion!r}, expected a list [k1, k2, ...].')
    coefficients = {str(i): value for i, value in enumerate(distortion)}
    fx, fy, cx, cy = (number(fields, key, path) for key in ("fx", "fy", "cx", "cy"))
    size = round(number(fields, width, path)), round(number(fields, height, path))
    try:
        k = tuple(number(coefficients, key, path) for key in coefficients)
        return Camera(*size, fx, fy, cx, cy, k)
    except DataError as error:
        raise DataError(f"{path}: {error}") from error
