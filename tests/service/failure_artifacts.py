"""Things of the flat, each with a name of its own, and somebody who knows them by sight.

A name says which thing it is, not of which kind: a label that lies on another thing is wrong, be it
another chair.
"""

import base64
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler
from threading import Semaphore

import numpy as np

from ldo_service.conversions.frames import crops_from_request
from ldo_service.detection.labellers.chat_completion import HttpConfig
from ldo_service.gaussians.model import GaussianMap
from ldo_service.geometry import codecs, se3
from ldo_service.geometry.codecs import shrunk
from ldo_service.schemas import LabelRequest
from ldo_service.semantics.gaussian_labels import top_labels
from ldo_service.synthetic.flat import FlatSequence
from tests.detection.labellers.server import replies_with

FILLED = 0.7  # of a box, by a thing that it is of
NEAR_M = 0.05  # of a surface, to lie on it: what the depth of a Kinect may be off by
TOLD_WITHIN_S = 10.0  # of a picture, that it was asked about; or never
NOT_TOLD = "none"


def flat() -> FlatSequence:
    """At a quarter of its pixels, so that a map of it is quickly made."""
    return FlatSequence.named("flat", width_px=320, height_px=240)


def exhibit(instance: int) -> str:
    return f"exhibit {instance}"


def thing_in(sequence: FlatSequence, frame: int, box_px: Iterable[float]) -> str:
    """The name of what fills most of a box, x0 y0 x1 y1, in a frame."""
    x0, y0, x1, y1 = (max(0, round(edge)) for edge in box_px)
    shown = sequence.labels(frame).instance_ids[y0 : y1 + 1, x0 : x1 + 1]
    pixels = np.bincount(shown.ravel())
    instance = int(pixels.argmax())
    is_filled = instance > 0 and pixels[instance] >= FILLED * shown.size
    return exhibit(instance) if is_filled else NOT_TOLD


@dataclass
class Guide:
    """Answers the questions of a labeller, of whose pictures it was told what they show.

    frames  of the sequence, in the order that a camera sends them again and again
    waits   with each answer until it is allowed
    """

    sequence: FlatSequence
    frames: Sequence[int]
    waits: bool = False
    names: dict[str, str] = field(default_factory=dict)  # by picture, as a labeller sends it
    _allowed: Semaphore = field(default_factory=lambda: Semaphore(0))

    def told(self, request: LabelRequest, frame: int) -> None:
        """Of a region that the frame with this number shows."""
        index = self.frames[frame % len(self.frames)]
        name = thing_in(self.sequence, index, request.box_px)
        self.names |= {_picture(crop): name for crop in crops_from_request(request)}

    def allow(self, answers: int) -> None:
        self._allowed.release(answers)

    def __call__(self, handler: BaseHTTPRequestHandler) -> None:
        over, question = handler.ended, handler.payload  # type: ignore[attr-defined]
        while self.waits and not self._allowed.acquire(timeout=0.1):
            if over.is_set():
                return
        picture = question["messages"][0]["content"][1]["image_url"]["url"].split(",")[1]
        until_s = time.monotonic() + TOLD_WITHIN_S
        while picture not in self.names and time.monotonic() < until_s and not over.wait(0.02):
            pass
        replies_with(self.names.get(picture, NOT_TOLD), 0.9)(handler)


def _picture(crop: np.ndarray) -> str:
    jpeg = codecs.encode_jpeg(shrunk(crop, HttpConfig().side_px))
    return base64.b64encode(jpeg).decode()


# --- where names came to lie ----------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Placed:
    """Gaussians with a name, as often as a frame sees them; `right`: on the thing itself."""

    seen: int
    right: int
    names: frozenset[str]

    @property
    def share(self) -> float:
        return self.right / max(self.seen, 1)


def placed(
    gaussians: GaussianMap,
    label_names: Sequence[str],
    sequence: FlatSequence,
    first: int,
    frames: range,
) -> Placed:
    """How many of the Gaussians that are named as an exhibit lie on it. `first`: the frame that the
    map begins with."""
    names = np.array(label_names)[top_labels(gaussians.labels)]
    is_named = np.char.startswith(names, "exhibit ")
    instances = np.array([int(name.split()[1]) for name in names[is_named]], int)
    p_map = gaussians.means[is_named].astype(float)
    shown = [*_shown(sequence, first, frames, p_map)]
    seen = sum(len(which) for which, _ in shown)
    right = sum(int(np.sum(instances[which] == truth)) for which, truth in shown)
    return Placed(seen, right, frozenset(names[is_named].tolist()))


def _shown(
    sequence: FlatSequence, first: int, frames: range, p_map: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Of each frame which points [N, 3] lie on a surface that it shows, and of which thing that
    is."""
    T, camera = sequence.truth().T_world_camera, sequence.camera
    for frame in frames:
        T_camera_map = se3.inverse(T[frame]) @ T[first]
        p_camera = p_map @ T_camera_map[:3, :3].T + T_camera_map[:3, 3]
        ahead = np.flatnonzero(p_camera[:, 2] > 0.1)
        u, v = np.round(camera.project(p_camera[ahead])).astype(int).T
        inside = (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
        which, u, v = ahead[inside], u[inside], v[inside]
        near = np.abs(sequence[frame].depth_m[v, u] - p_camera[which, 2]) < NEAR_M
        yield which[near], sequence.labels(frame).instance_ids[v[near], u[near]]
