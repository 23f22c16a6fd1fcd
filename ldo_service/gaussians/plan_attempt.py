"""Attempt to run a plan of iterations on a device that may fail before the plan ends."""

from collections.abc import Callable
from dataclasses import replace
from typing import Protocol

import numpy as np

from .exposure import Exposure
from .renderer import VisibleGaussians
from .training_views import TrainingView

Observer = Callable[[int, VisibleGaussians], None]


class Views(Protocol):
    """Interface to training views by keyframe; the optimizer writes new exposures and poses."""

    def __getitem__(self, keyframe: int) -> TrainingView: ...

    def __setitem__(self, keyframe: int, view: TrainingView) -> None: ...


class PlanAttempt:
    """Attempt to run a plan of iterations; `undo` reverses it after the device has failed.

    The iterations read and write the training views through this object. A changed view is written
    to `views` immediately, and `undo` restores it. The observer is called only by `commit`.

    Args:
        views: Training views by keyframe.
        observe: Function to call with the keyframe and the visible Gaussians of each iteration;
            None for none.
    """

    def __init__(self, views: Views, observe: Observer | None) -> None:
        self._views, self._observer = views, observe
        self._before: dict[int, tuple[np.ndarray, Exposure]] = {}
        self._observed: list[tuple[int, VisibleGaussians]] = []

    def __getitem__(self, keyframe: int) -> TrainingView:
        view = self._views[keyframe]
        self._before.setdefault(keyframe, (view.T_map_camera.copy(), view.exposure))
        return view

    def __setitem__(self, keyframe: int, view: TrainingView) -> None:
        self._views[keyframe] = view

    def observe(self, keyframe: int, visible: VisibleGaussians) -> None:
        """Store the visible Gaussians of an iteration until `commit` or `undo`."""
        if self._observer is not None:
            self._observed.append((keyframe, visible))

    def commit(self) -> None:
        """Call the observer with all stored observations."""
        for keyframe, visible in self._observed:
            assert self._observer is not None
            self._observer(keyframe, visible)

    def undo(self) -> None:
        """Restore poses and exposures of the views, and drop the stored observations."""
        self._observed.clear()
        for keyframe, (T_map_camera, exposure) in self._before.items():
            view = self._views[keyframe]
            self._views[keyframe] = replace(view, T_map_camera=T_map_camera, exposure=exposure)
