"""What the odometry remembers from frame to frame, and its form on disk."""

from dataclasses import asdict, dataclass, field, replace
from enum import StrEnum
from typing import Any

import numpy as np

from .keyframe_database import Place, Places, PlacesConfig
from .keyframes import Keyframe
from .motion import Motion
from .motion_segmentation import Suspicion
from .odometry_prior import Anchor
from .pyramid import PyramidConfig
from .submaps import Submaps
from .tracking_quality import History, Status


class Origin(StrEnum):
    """Of the keyframe tracked against, where a map holds many."""

    NEW = "new"
    TIED = "tied"  # new, and measured from a known one
    KNOWN = "known"  # made long before, with all that it shows


@dataclass(frozen=True, slots=True)
class State:
    places: Places = field(default_factory=Places)  # for relocalisation
    keyframe: Keyframe | None = None  # the one tracked against, usually the newest
    supporting: Place | None = None  # the last frame mapped, where it is none of these
    motion: Motion = field(default_factory=Motion)
    history: History = field(default_factory=History)
    status: Status = Status.OK
    frames_since_keyframe: int = 0
    next_id: int = 0  # of the next keyframe
    origin: Origin = Origin.NEW
    trusted: np.ndarray = field(default_factory=lambda: np.zeros(0, np.int8))  # thumbnail
    searches: int = 0  # frames that were looked for among the places
    segments: Submaps = field(default_factory=Submaps)
    T_odom_mapped: np.ndarray = field(default_factory=lambda: np.eye(4))  # the last frame mapped
    is_moving: np.ndarray | None = None  # [H, W] bool of the last frame, at working resolution
    suspicion: Suspicion | None = None
    anchor: Anchor | None = None  # the last OK frame, where a prior says where it was too

    def with_new(
        self, keyframe: Keyframe, place: Place, config: PlacesConfig, *, is_tied: bool
    ) -> "State":
        """Tracking against the frame just tracked, which is a keyframe and a place from now on."""
        return replace(
            self._against(keyframe, keyframe.T_odom_keyframe),
            places=self.places.added(place, config),
            next_id=keyframe.id + 1,
            origin=Origin.TIED if is_tied else Origin.NEW,
        )

    def with_known(self, keyframe: Keyframe, place: Place, T_odom_camera: np.ndarray) -> "State":
        """Tracking against a keyframe of old, seen from T_odom_camera [4, 4] by the last frame."""
        return replace(
            self._against(keyframe, T_odom_camera),
            places=self.places.returned_to(place),
            origin=Origin.KNOWN,
            is_moving=None,
        )

    def _against(self, keyframe: Keyframe, T_odom_mapped: np.ndarray) -> "State":
        return replace(
            self,
            keyframe=keyframe,
            supporting=None,
            frames_since_keyframe=0,
            T_odom_mapped=T_odom_mapped,
            suspicion=self.suspicion and self.suspicion.of_new_keyframe(),
        )


def packed(state: State) -> dict[str, Any]:
    """Arrays and plain values. The keyframe is grey image, depth and pose: the rest follows."""
    return {
        "places": [place.packed for place in state.places.all],
        "keyframe": None if state.keyframe is None else state.keyframe.packed,
        "supporting": None if state.supporting is None else state.supporting.packed,
        "motion": asdict(state.motion),
        "history": asdict(state.history),
        "status": state.status.value,
        "frames_since_keyframe": state.frames_since_keyframe,
        "next_id": state.next_id,
        "origin": state.origin.value,
        "trusted": state.trusted,
        "searches": state.searches,
        "segments": state.segments.packed,
        "T_odom_mapped": state.T_odom_mapped,
        "is_moving": _bits(state.is_moving),
        "suspicion": state.suspicion and (_bits(state.suspicion.contradicts), state.suspicion.gone),
        "anchor": state.anchor and state.anchor.packed,
    }


def unpacked(values: dict[str, Any], config: PyramidConfig) -> State:
    """The inverse of `packed`, under the same configuration."""
    keyframe, suspicion, is_moving = values["keyframe"], values["suspicion"], values["is_moving"]
    supporting, anchor = values["supporting"], values["anchor"]
    return State(
        places=Places(tuple(Place.unpacked(place) for place in values["places"])),
        keyframe=None if keyframe is None else Keyframe.unpacked(keyframe, config),
        supporting=None if supporting is None else Place.unpacked(supporting),
        motion=Motion(**values["motion"]),
        history=History(**{name: tuple(noise) for name, noise in values["history"].items()}),
        status=Status(values["status"]),
        frames_since_keyframe=values["frames_since_keyframe"],
        next_id=values["next_id"],
        origin=Origin(values["origin"]),
        trusted=values["trusted"],
        searches=values["searches"],
        segments=Submaps.unpacked(values["segments"]),
        T_odom_mapped=values["T_odom_mapped"],
        is_moving=None if is_moving is None else _mask(is_moving),
        suspicion=None if suspicion is None else Suspicion(_mask(suspicion[0]), suspicion[1]),
        anchor=None if anchor is None else Anchor.unpacked(anchor),
    )


def _bits(mask: np.ndarray | None) -> dict[str, Any] | None:
    """A mask [H, W] bool in an eighth of its size: it is written at each frame."""
    return None if mask is None else {"bits": np.packbits(mask), "shape": list(mask.shape)}


def _mask(packed: dict[str, Any]) -> np.ndarray:
    height, width = packed["shape"]
    count = height * width
    return np.unpackbits(packed["bits"], count=count).reshape(height, width).astype(bool)
