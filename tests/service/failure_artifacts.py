"""Synthetic flat with one label per instance, a scripted labeller, and a check of the labels.

A label names the instance, not the class. A label on another instance is wrong, even if both are
chairs.
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

FILLED = 0.7  # Minimum fraction of a box that its instance fills.
NEAR_M = 0.05  # Maximum distance to a surface; the depth error of a Kinect is about as large.
KNOWN_WITHIN_S = 10.0  # Maximum wait until the label of a requested crop is known.
NO_LABEL = "none"


def flat() -> FlatSequence:
    """Return the synthetic flat at a quarter of its pixels, for fast mapping."""
    return FlatSequence.named("flat", width_px=320, height_px=240)


def instance_label(instance: int) -> str:
    return f"exhibit {instance}"


def label_in_box(sequence: FlatSequence, frame: int, box_px: Iterable[float]) -> str:
    """Return the label of the instance that fills most of a box (x0, y0, x1, y1) in a frame."""
    x0, y0, x1, y1 = (max(0, round(edge)) for edge in box_px)
    shown = sequence.labels(frame).instance_ids[y0 : y1 + 1, x0 : x1 + 1]
    pixels = np.bincount(shown.ravel())
    instance = int(pixels.argmax())
    is_filled = instance > 0 and pixels[instance] >= FILLED * shown.size
    return instance_label(instance) if is_filled else NO_LABEL


@dataclass
class Guide:
    """Scripted labelling server that knows the true label of each requested crop.

    Attributes:
        frames: Frames of the sequence, in the order in which the camera repeats them.
        waits: Whether each answer waits until it is allowed.
        names: Label by crop, as the labeller sends the crop.
    """

    sequence: FlatSequence
    frames: Sequence[int]
    waits: bool = False
    names: dict[str, str] = field(default_factory=dict)
    _allowed: Semaphore = field(default_factory=lambda: Semaphore(0))

    def add_request(self, request: LabelRequest, frame: int) -> None:
        """Store the true label of a requested region of the frame with this number."""
        index = self.frames[frame % len(self.frames)]
        name = label_in_box(self.sequence, index, request.box_px)
        self.names |= {_picture(crop): name for crop in crops_from_request(request)}

    def allow(self, answers: int) -> None:
        self._allowed.release(answers)

    def __call__(self, handler: BaseHTTPRequestHandler) -> None:
        over, question = handler.ended, handler.payload  # type: ignore[attr-defined]
        while self.waits and not self._allowed.acquire(timeout=0.1):
            if over.is_set():
                return
        picture = question["messages"][0]["content"][1]["image_url"]["url"].split(",")[1]
        until_s = time.monotonic() + KNOWN_WITHIN_S
        while picture not in self.names and time.monotonic() < until_s and not over.wait(0.02):
            pass
        replies_with(self.names.get(picture, NO_LABEL), 0.9)(handler)


def _picture(crop: np.ndarray) -> str:
    jpeg = codecs.encode_jpeg(shrunk(crop, HttpConfig().side_px))
    return base64.b64encode(jpeg).decode()


# --- labels in the map ----------------------------------------------------------------------------
@dataclass(frozen=True, slots=True)
class Placed:
    """Number of observations of labelled Gaussians: all (`seen`) and correct ones (`right`)."""

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
    """Count how often labelled Gaussians lie on the instance of their label.

    `first` is the frame in which the map starts.
    """
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
    """Yield, per frame, the indices of the points [N, 3] on a visible surface and its instances."""
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
