"""Contact sheet of rendered views and camera images."""

from collections.abc import Callable

import cv2
import numpy as np

from .pictures import contact_sheet, depth_picture, depth_range, error_picture
from .views import RenderedView, RenderingErrors, ViewErrors

VIEWS = 6
ERROR_GAIN = 4  # An error of a quarter of the range is white.
WIDTH_PX = 320  # Largest width of an image.
CAPTIONS = ["camera", "map", f"error x {ERROR_GAIN}", "camera depth", "map depth"]


def rendering_sheet(
    errors: RenderingErrors, view_of_frame: Callable[[int], RenderedView], count: int = VIEWS
) -> np.ndarray:
    """Draw rows [camera, map, error, camera depth, map depth] of some frames, as uint8 RGB.

    The text above a row gives the frame number, its PSNR and the common range of both depth images.
    The frames are those with the best and the worst PSNR, and others evenly spread over the run.

    Args:
        errors: Rendering errors of the frames.
        view_of_frame: Function that takes a frame index and returns the rendered view of the frame.
        count: Number of frames.

    Raises:
        ValueError: If there are no frames.
    """
    shown = some_of(errors.views, count)
    views = [view_of_frame(one.frame) for one in shown]
    notes = [_note(one, errors.views) for one in shown]
    labels = [f"{note}; {_scale(view)}" for note, view in zip(notes, views, strict=True)]
    return contact_sheet([_pictures(view) for view in views], CAPTIONS, labels)


def some_of(views: tuple[ViewErrors, ...], count: int = VIEWS) -> list[ViewErrors]:
    """Choose the views with the best and the worst PSNR, and others evenly spread over the frames.

    The result is sorted by frame index.
    """
    special = {_worst(views), _best(views)} if views else set()
    others = [view for view in views if view not in special]
    places = np.linspace(0, len(others), max(0, count - len(special)), endpoint=False)
    spread = {others[int(place)] for place in places} if others else set()
    return sorted(special | spread, key=lambda view: view.frame)


def _worst(views: tuple[ViewErrors, ...]) -> ViewErrors:
    return min(views, key=lambda view: view.psnr_db)


def _best(views: tuple[ViewErrors, ...]) -> ViewErrors:
    return max(views, key=lambda view: view.psnr_db)


def _note(one: ViewErrors, views: tuple[ViewErrors, ...]) -> str:
    rank = ", the best" * (one == _best(views)) or ", the worst" * (one == _worst(views))
    return f"frame {one.frame}: {one.psnr_db:.2f} dB{rank}"


def _pictures(view: RenderedView) -> list[np.ndarray]:
    range_m = _range_m(view)
    return [
        shrunk(picture)
        for picture in (
            view.frame.color,
            view.picture,
            error_picture(view.seen, view.shown, ERROR_GAIN),
            depth_picture(view.frame.depth_m, range_m),
            depth_picture(view.rendering.depth_m, range_m),
        )
    ]


def _scale(view: RenderedView) -> str:
    nearest_m, farthest_m = _range_m(view)
    return f"depth {nearest_m:.2f} m (red) to {farthest_m:.2f} m (blue)"


def _range_m(view: RenderedView) -> tuple[float, float]:
    """Return the depth range of the frame, or of the rendering if the frame has no depth."""
    measured_m = view.frame.depth_m
    return depth_range(measured_m if measured_m.any() else view.rendering.depth_m)


def shrunk(image: np.ndarray) -> np.ndarray:
    """Return the image, scaled down to at most WIDTH_PX in width."""
    height, width = image.shape[:2]
    if width <= WIDTH_PX:
        return image
    size = (WIDTH_PX, max(1, round(height * WIDTH_PX / width)))
    return cv2.resize(image, size, interpolation=cv2.INTER_AREA)
