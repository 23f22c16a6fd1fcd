"""Images of training views as the optimizer compares them, with a cache of the halved ones."""

from collections import OrderedDict
from functools import cached_property
from weakref import ref

import numpy as np

from .exposure import ImageBlocks
from .training_views import TrainingView

# Number of halved views in the cache. A third of the iterations after a new keyframe use this
# keyframe. A view at half resolution takes 0.5 MB for images of 640x480 pixels.
MAX_IMAGES = 16


class PreparedImage:
    """Images of a training view in the resolution of a rendering.

    Attributes:
        image: The view in this resolution. Its exposure and pose are those at its creation.
    """

    def __init__(self, view: TrainingView, *, is_half: bool) -> None:
        self.image = view.halved() if is_half else view
        self._of = tuple(image if image is None else ref(image) for image in _images(view))

    def shows(self, view: TrainingView) -> bool:
        """Return whether these are the images of `view`."""
        known = (image and image() for image in self._of)
        return all(a is b for a, b in zip(known, _images(view), strict=True))

    @cached_property
    def blocks(self) -> ImageBlocks:
        """Mean colors of pixel blocks, for the estimate of the exposure; computed on first use."""
        return ImageBlocks.of(self.image.color, self.image.mask)


class PreparedImages:
    """Cache of prepared images at half resolution, of the last `MAX_IMAGES` views.

    Images at full resolution are not kept: they would need more memory than the time is worth. Not
    thread-safe.
    """

    def __init__(self) -> None:
        self._known: OrderedDict[int, PreparedImage] = OrderedDict()

    def get(self, view: TrainingView, *, is_half: bool) -> PreparedImage:
        """Return the images of a view, at half resolution if `is_half` is True.

        Halved images are prepared again if the view has other arrays of color, depth or mask than
        before.
        """
        if not is_half:
            return PreparedImage(view, is_half=False)
        known = self._known.get(view.keyframe)
        if known is None or not known.shows(view):
            self._known[view.keyframe] = known = PreparedImage(view, is_half=True)
        self._known.move_to_end(view.keyframe)
        if len(self._known) > MAX_IMAGES:
            self._known.popitem(last=False)
        return known


def _images(view: TrainingView) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    return view.color, view.depth_m, view.mask
