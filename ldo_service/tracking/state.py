"""What the odometry remembers from frame to frame, and its form on disk."""

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from ldo_service.geometry import Camera

from .judgement import History, Status
from .keyframes import Keyframe
from .motion import Motion
from .moving import Suspicion
from .pyramid import PyramidConfig, build_pyramid


@dataclass(frozen=True, slots=True)
class State:
    memory: tuple[Keyframe, ...] = ()  # for relocalisation, oldest first
    keyframe: Keyframe | None = None  # the one tracked against, usually the newest
    motion: Motion = field(default_factory=Motion)
    history: History = field(default_factory=History)
    status: Status = Status.OK
    frames_since_keyframe: int = 0
    next_id: int = 0  # of the next keyframe
    T_odom_mapped: np.ndarray = field(default_factory=lambda: np.eye(4))  # the last frame mapped
    is_moving: np.ndarray | None = None  # [H, W] bool of the last frame, at working resolution
    suspicion: Suspicion | None = None


def packed(state: State) -> dict[str, Any]:
    """Arrays and plain values. Keyframes are grey image, depth and pose: the rest follows."""
    current = state.keyframe
    forgotten = () if current is None or current in state.memory else (current,)
    kept = (*forgotten, *state.memory)
    return {
        "keyframes": [_packed(k) for k in kept],  # what of them never changes
        "moved": [(k.has_moved, k.left_out) for k in kept],
        "memory": len(state.memory),
        "current": -1 if current is None else kept.index(current),
        "motion": asdict(state.motion),
        "history": asdict(state.history),
        "status": state.status.value,
        "frames_since_keyframe": state.frames_since_keyframe,
        "next_id": state.next_id,
        "T_odom_mapped": state.T_odom_mapped,
        "is_moving": state.is_moving,
        "suspicion": state.suspicion and (state.suspicion.contradicts, state.suspicion.gone),
    }


def unpacked(values: dict[str, Any], config: PyramidConfig) -> State:
    """The inverse of `packed`, under the same configuration."""
    kept = tuple(
        _unpacked(k, moved, config)
        for k, moved in zip(values["keyframes"], values["moved"], strict=True)
    )
    return State(
        memory=kept[len(kept) - values["memory"] :],
        keyframe=kept[values["current"]] if values["current"] >= 0 else None,
        motion=Motion(**values["motion"]),
        history=History(**{name: tuple(noise) for name, noise in values["history"].items()}),
        status=Status(values["status"]),
        frames_since_keyframe=values["frames_since_keyframe"],
        next_id=values["next_id"],
        T_odom_mapped=values["T_odom_mapped"],
        is_moving=values["is_moving"],
        suspicion=values["suspicion"] and Suspicion(*values["suspicion"]),
    )


def _packed(keyframe: Keyframe) -> dict[str, Any]:
    view = keyframe.view
    return {
        "gray": view.gray,
        "depth_m": view.depth_m,
        "camera": asdict(view.camera),
        "T_odom_keyframe": keyframe.T_odom_keyframe,
        "id": keyframe.id,
    }


def _unpacked(
    kept: dict[str, Any],
    moved: tuple[np.ndarray | None, np.ndarray | None],
    config: PyramidConfig,
) -> Keyframe:
    camera = Camera(**{**kept["camera"], "distortion": tuple(kept["camera"]["distortion"])})
    view = build_pyramid(kept["gray"], kept["depth_m"], camera, config)
    return Keyframe(view, kept["T_odom_keyframe"], kept["id"], *moved)
