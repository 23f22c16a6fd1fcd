"""The odometry's state as arrays and plain values, and back."""

from dataclasses import asdict
from typing import Any

from ldo_service.geometry import Camera

from .judgement import History, Status
from .keyframes import Keyframe
from .motion import Motion
from .pyramid import PyramidConfig, build_pyramid

State = tuple[tuple[Keyframe, ...], Keyframe | None, Motion, History, Status, int]


def taken(
    memory: tuple[Keyframe, ...],
    keyframe: Keyframe | None,
    motion: Motion,
    history: History,
    status: Status,
    frames_since_keyframe: int,
) -> dict[str, Any]:
    """Keyframes as grey image, depth and pose: everything else is computed from them again."""
    kept = memory if keyframe is None or keyframe in memory else (keyframe, *memory)
    return {
        "keyframes": [_closed(k) for k in kept],
        "memory": len(memory),
        "current": -1 if keyframe is None else kept.index(keyframe),
        "motion": asdict(motion),
        "history": asdict(history),
        "status": status.value,
        "frames_since_keyframe": frames_since_keyframe,
    }


def opened(state: dict[str, Any], config: PyramidConfig) -> State:
    kept = tuple(_opened(k, config) for k in state["keyframes"])
    return (
        kept[len(kept) - state["memory"] :],
        kept[state["current"]] if state["current"] >= 0 else None,
        Motion(**state["motion"]),
        History(**{name: tuple(values) for name, values in state["history"].items()}),
        Status(state["status"]),
        state["frames_since_keyframe"],
    )


def _closed(keyframe: Keyframe) -> dict[str, Any]:
    view = keyframe.view
    return {
        "gray": view.gray,
        "depth_m": view.depth_m,
        "camera": asdict(view.camera),
        "T_odom_keyframe": keyframe.T_odom_keyframe,
        "index": keyframe.index,
    }


def _opened(kept: dict[str, Any], config: PyramidConfig) -> Keyframe:
    camera = Camera(**{**kept["camera"], "distortion": tuple(kept["camera"]["distortion"])})
    view = build_pyramid(kept["gray"], kept["depth_m"], camera, config)
    return Keyframe(view, kept["T_odom_keyframe"], kept["index"])
