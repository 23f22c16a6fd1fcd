"""Measurements as arrays, for an actor's saved state: the same bits come back."""

from collections.abc import Iterable, Mapping

import numpy as np

from ldo_service.geometry.keyframe_poses import RelativePose

from .factors import Sight

Packed = dict[str, np.ndarray]


def pack_relative(measured: Iterable[RelativePose]) -> Packed:
    measured = list(measured)
    return {
        "pairs": np.array([(m.a, m.b) for m in measured], np.int64).reshape(-1, 2),
        "T_a_b": np.array([m.T_a_b for m in measured], float).reshape(-1, 4, 4),
        "information": np.array([m.information for m in measured], float).reshape(-1, 6, 6),
    }


def unpack_relative(packed: Mapping[str, np.ndarray]) -> list[RelativePose]:
    return [
        RelativePose(int(a), int(b), T_a_b, information)
        for (a, b), T_a_b, information in zip(
            packed["pairs"], packed["T_a_b"], packed["information"], strict=True
        )
    ]


def pack_sights(sights: Iterable[Sight]) -> Packed:
    sights = list(sights)
    return {
        "pairs": np.array([(s.keyframe, s.landmark) for s in sights], np.int64).reshape(-1, 2),
        "centers_px": np.array([s.center_px for s in sights], float).reshape(-1, 2),
        "intrinsics": np.array([s.intrinsics for s in sights], float).reshape(-1, 4),
        "sigmas_px": np.array([s.sigma_px for s in sights], float),
        "weights": np.array([s.weight for s in sights], float),
    }


def unpack_sights(packed: Mapping[str, np.ndarray]) -> list[Sight]:
    columns = (packed[name] for name in ("centers_px", "sigmas_px", "intrinsics", "weights"))
    return [
        Sight(int(keyframe), int(landmark), center_px, float(sigma_px), intrinsics, float(weight))
        for (keyframe, landmark), center_px, sigma_px, intrinsics, weight in zip(
            packed["pairs"], *columns, strict=True
        )
    ]
