"""Construction of the map from keyframes: densification, optimization, pruning and offloading."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.geometry import Camera, RgbdFrame

from .change_log import ChangeLog, Changes, PublishedPoses
from .confirmation import Confirmation
from .densification import densify
from .exposure import Exposure, estimate_exposure
from .fitting import Fitting
from .keyframe_renderer import KeyframeRenderer
from .keyframe_store import KeyframeStore, KeyframeViews
from .map_builder_config import MapBuilderConfig
from .map_files import MapFiles
from .model import GaussianBatch, GaussianMap
from .offloading import OffloadedGaussians, iter_all_gaussians
from .plan_attempt import Observer
from .pruning import find_duplicates, prunable_mask
from .renderer import Contributions, Rendering, RenderMemory
from .training_views import TrainingView, ignored_pixels, visible_in_mask
from .visibility import BoundingSpheres, MaxDepthGrid, PlacedCamera, chunk_numbers, plan_offload

# Maximum iterations per unit of effort: (0.8 / 0.38 + 0.2) * 2 if almost no Gaussian is visible.
MAX_ITERATIONS_PER_EFFORT = 5
# Files in a map folder that snapshots of the map refer to: keyframe images, offloaded Gaussians.
FILE_PATTERNS = ("images/*.keyframe", "gaussians/*.gaussians")


class MapBuilder:
    """Builder of the map: it holds the map, its keyframes, the optimizer and the change log.

    The same calls in the same order give bitwise equal maps, for any number of threads and also
    after `restore`. Not thread-safe.
    """

    def __init__(
        self,
        config: MapBuilderConfig | None = None,
        *,
        folder: Path | None = None,
        threads: int = 1,
    ) -> None:
        """Create an empty map.

        Args:
            config: Settings.
            folder: Folder for keyframe images and offloaded Gaussians; None for a temporary one.
            threads: Threads of the renderer and the optimizer.
        """
        self.config = config or MapBuilderConfig()
        self.gaussians = GaussianMap()
        self.offloaded = OffloadedGaussians(folder and folder / "gaussians")
        self.views = KeyframeViews(KeyframeStore(folder and folder / "images", self.config.store))
        self.files = MapFiles(self.offloaded, self.views.store)
        self._threads = threads
        self._confirmation = Confirmation(self.views.store, self.config.pruning, self.config.seed)
        self.fitting = Fitting(
            self.config.optimizer,
            self.config.sampling,
            self.views,
            self.is_resident,
            seed=self.config.seed,
            threads=threads,
        )
        self._renderer = KeyframeRenderer(self.views, self.fitting)
        self._insertion_memory = RenderMemory()  # Used by the rendering of new Gaussians.
        self._log = ChangeLog()
        self._published = PublishedPoses(self.config.refined_m, self.config.refined_rad)
        self._newest: int | None = None
        self._pruned = self._excess = 0

    # --- keyframes --------------------------------------------------------------------------------
    def add(
        self,
        frame: RgbdFrame,
        T_map_camera: np.ndarray,
        keyframe: int,
        iterations: int,
        dynamic_mask: np.ndarray | None = None,
        correction: CameraCorrection | None = None,
    ) -> None:
        """Add a new keyframe to the map, and fit the map to it and to some older keyframes.

        Where the map lacks surface, new Gaussians are added and anchored to the keyframe. If the
        correction of the camera has changed, the images of older keyframes are converted to it.
        The black rim that rectification leaves is not mapped.

        Args:
            frame: Color and depth of the keyframe.
            T_map_camera: Pose of the keyframe, [4, 4].
            keyframe: Id of the keyframe, larger than all earlier ids.
            iterations: Limit of the computing time; see `effort` in `GaussianOptimizer.optimize`.
                Most iterations run at half resolution.
            dynamic_mask: Pixels of moving objects, which are not mapped, [H, W] bool; None if none.
            correction: Correction of the camera that was applied to the frame; None if none.
        """
        self.views.convert_to(correction or CameraCorrection())
        horizon = MaxDepthGrid.of(frame.depth_m)
        self._load_visible(PlacedCamera(frame.camera, T_map_camera, horizon))
        self._renderer.forget()
        before = self.render_from(frame.camera, T_map_camera)
        ignored = ignored_pixels(frame, dynamic_mask)
        view = TrainingView.of(frame, T_map_camera, keyframe, ignored)
        view = replace(view, exposure=self._exposure(view, before))
        self._insert(frame, view, before)
        self._published.add(keyframe, T_map_camera)
        self._newest = keyframe
        for forgotten in self.views.add(view, horizon):
            self._published.forget(forgotten)
            self.fitting.forget_view(forgotten)
        check = self._confirmation.start(keyframe, len(self.gaussians))
        plan = self.fitting.plan(view, MAX_ITERATIONS_PER_EFFORT * iterations, check.keyframes)
        touched = self._fit(plan, effort=iterations, after_keyframe=True, observe=check.observe)
        mask = check.hidden_mask(self.gaussians.anchors)
        if len(self.views) % self.config.prune_keyframes == 0:
            mask |= self._misshapen_mask(touched)
        self._remove(mask)

    def render_from(
        self, camera: Camera, T_map_camera: np.ndarray, *, contributions: bool = False
    ) -> Rendering:
        """Render the Gaussians in memory from a camera pose T_map_camera [4, 4].

        With `contributions`, the contribution of each Gaussian is computed too.
        """
        return self._renderer.render_from(
            self.gaussians, camera, T_map_camera, contributions=contributions
        )

    def render_keyframe(self, keyframe: int, *, contributions: bool = False) -> Rendering:
        """Render the Gaussians in memory at the pose of a keyframe, or return the cached rendering.

        The cache is valid until the map changes. With `contributions`, the contribution of each
        Gaussian is computed too.
        """
        return self._renderer.render_keyframe(self.gaussians, keyframe, contributions=contributions)

    def _exposure(self, view: TrainingView, before: Rendering) -> Exposure:
        """Estimate the exposure of a new keyframe relative to the map.

        If the estimate fails, for example because the map covers too little of the image, the
        exposure of the previous keyframe is returned. The first keyframe then gets gain 1, bias 0.
        """
        rendered = before.color.transpose(2, 0, 1)
        estimated = estimate_exposure(rendered, before.opacity, view.color, view.mask)
        if estimated is not None or self._newest is None:
            return estimated or Exposure()
        return self.views.exposures[self._newest]

    def _insert(self, frame: RgbdFrame, view: TrainingView, before: Rendering) -> None:
        densify(
            self.gaussians,
            replace(frame, color=view.exposure.removed_from_image(frame.color)),
            view.T_map_camera,
            view.keyframe,
            self.config.insertion,
            before=before,
            ignore_mask=None if view.mask is None else view.mask == 0,
            memory=self._insertion_memory,
            threads=self._threads,
        )
        self._log.mark_added(self.gaussians)

    def remove_masked(self, keyframe: int, pixels: np.ndarray) -> int:
        """Remove the Gaussians that a keyframe added at pixels which show moving objects.

        Gaussians are removed if they are anchored to the keyframe and project into these pixels.
        The pixels are excluded from later fitting. The number of removed Gaussians is returned.

        Args:
            keyframe: Id of the keyframe.
            pixels: Mask, [H, W] bool.

        Raises:
            KeyError: The images of the keyframe are dropped or unreadable.
        """
        self._load_visible(self.views.placed(keyframe))
        self._renderer.forget()
        self.views.store.mask_pixels(keyframe, pixels)
        theirs = np.flatnonzero(self.gaussians.anchors == keyframe)
        camera, T_map_camera = self.views.cameras[keyframe], self.views.poses[keyframe]
        is_there = visible_in_mask(pixels, self.gaussians.means[theirs], camera, T_map_camera)
        mask = np.zeros(len(self.gaussians), bool)
        mask[theirs[is_there]] = True
        self._remove(mask)
        return int(np.count_nonzero(mask))

    # --- fitting ----------------------------------------------------------------------------------
    def refine(
        self,
        iterations: int,
        rates: tuple[float, float] = (1.0, 1.0),
        *,
        first: Sequence[int] = (),
        effort: float = inf,
    ) -> int:
        """Fit the map to random keyframes.

        The keyframes of `first` alternate with random ones until all keyframes of `first` are used.

        Args:
            iterations: Number of iterations.
            rates: Factors on the learning rates at the first and at the last iteration.
            first: Keyframes that must be used.
            effort: Limit of the computation; see `GaussianOptimizer.optimize`.

        Returns:
            Number of iterations that were run. It is below `iterations` if `effort` was reached, or
            if most keyframes were skipped, because offloaded Gaussians may be visible in them.
        """
        self._renderer.forget()
        before = self.fitting.iterations
        self._fit(self.fitting.plan_refinement(iterations, first), rates, effort)
        return self.fitting.iterations - before

    def _fit(
        self,
        plan: Iterable[int],
        rates: tuple[float, float] = (1.0, 1.0),
        effort: float = inf,
        after_keyframe: bool = False,
        observe: Observer | None = None,
    ) -> np.ndarray:
        touched = self.fitting.fit(self.gaussians, plan, rates, effort, after_keyframe, observe)
        self._log.changed(touched)
        return touched

    def is_resident(self, keyframe: int) -> bool:
        """Return whether all Gaussians that may be visible in a keyframe are in memory.

        If some are offloaded, do not fit the map to this keyframe. Otherwise the Gaussians in
        memory would move into the gaps that the offloaded Gaussians leave.
        """
        return not self.offloaded.visible_chunks(self.views.placed(keyframe), self._reach_m)

    # --- after a correction -----------------------------------------------------------------------
    def deduplicate_keyframe(self, keyframe: int, iterations: int) -> int:
        """Remove the Gaussians of a keyframe that duplicate older Gaussians, after a loop closure.

        The map is then fitted to this keyframe. One call takes a short time, so that the caller can
        map new keyframes between two calls. The number of removed Gaussians is returned.

        Args:
            keyframe: Id of the keyframe. If its images were dropped, nothing is done.
            iterations: Number of iterations of the fit.
        """
        if keyframe not in self.views.cameras:
            return 0
        self._renderer.forget()
        self._load_visible(self.views.placed(keyframe))
        mask = find_duplicates(
            self.gaussians.rows, self.gaussians.anchors, keyframe, self.config.merging
        )
        self._remove(mask)
        self._fit([keyframe] * iterations)
        return int(np.count_nonzero(mask))

    # --- pruning ----------------------------------------------------------------------------------
    def _misshapen_mask(self, touched: np.ndarray) -> np.ndarray:
        """Return the mask of transparent or oversized rows among the rows in `touched` [N]."""
        mask = touched.copy()  # Few rows, so the time does not grow with the map.
        mask[touched] = prunable_mask(self.gaussians.rows[touched], self.config.pruning)
        return mask

    def _remove(self, mask: np.ndarray) -> None:
        self._log.mark_removed(self.gaussians, mask)
        self._pruned += self.gaussians.remove(mask)

    # --- labels -----------------------------------------------------------------------------------
    def visible_contributions(self, keyframe: int) -> Contributions:
        """Return the contributions of the Gaussians to the image of a keyframe.

        Offloaded Gaussians that may be visible in the keyframe are loaded first.
        """
        self.load_visible(keyframe)
        shown = self.render_keyframe(keyframe, contributions=True).contributions
        assert shown is not None
        return shown

    def load_visible(self, keyframe: int) -> None:
        """Load the offloaded Gaussians that may be visible in a keyframe."""
        self._load_visible(self.views.placed(keyframe))

    def mark_relabeled(self, indices: np.ndarray) -> None:
        """Record that the labels of these rows have changed, so that they are published again."""
        self._log.changed(np.isin(np.arange(len(self.gaussians)), indices))

    # --- offloading -------------------------------------------------------------------------------
    @property
    def _reach_m(self) -> float:
        return self.config.offload.reach_m

    def _load_visible(self, camera: PlacedCamera) -> None:
        seen = self.offloaded.visible_chunks(camera, self._reach_m)
        ids = self.offloaded.load_into(self.gaussians, seen)
        if len(ids):
            self._renderer.forget()
        self._log.mark_loaded(self.gaussians, ids)

    def offload_excess(self) -> None:
        """Offload Gaussians to disk if too many are in memory.

        Call it only after all changes were published, because it clears the record of unpublished
        changes. Map replicas keep the offloaded Gaussians.
        """
        if len(self.gaussians) <= self.config.offload.max_active:
            return
        keyframes = list(self.views.cameras)[-self.config.recent_cameras :]
        recent = [self.views.placed(keyframe) for keyframe in keyframes]
        rows, anchors = self.gaussians.rows, self.gaussians.anchors
        chunks = chunk_numbers(self.gaussians.means, anchors, self.config.offload.chunk_edge_m)
        resident = BoundingSpheres.around(rows, anchors, chunks)
        choice = plan_offload(resident, recent, self.config.offload)
        self._excess = choice.excess
        self.offloaded.offload_from(self.gaussians, chunks, choice.chunks)
        self._renderer.forget()
        self._log.mark_all_published(self.gaussians)

    def size(self) -> int:
        """Return the number of Gaussians in memory and on disk together."""
        return len(self.gaussians) + len(self.offloaded)

    def batches(self) -> Iterator[GaussianBatch]:
        """Yield the whole map in batches; ids ascend within and across batches."""
        yield from iter_all_gaussians(self.gaussians, self.offloaded)

    # --- publication ------------------------------------------------------------------------------
    def changes(self, *, with_changed: bool) -> Changes:
        """Return the changes to publish; see `ChangeLog.drain`."""
        self._log.lost(self.offloaded.pop_lost_ids(self.gaussians))
        return self._log.drain(self.gaussians, with_changed=with_changed)

    def refined(self) -> dict[int, np.ndarray]:
        """Return the poses T_map_keyframe [4, 4], by id, that the Gaussian optimizer has moved.

        The caller must publish these poses: the next call returns only poses that have moved again.
        """
        return self._published.drain(self.views.poses)

    def move_keyframes(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Move keyframes and the Gaussians anchored to them, after a correction of the pose graph.

        Args:
            T_new_old: Transforms [4, 4] by keyframe id, see `GaussianMap.move_anchors`.
        """
        T_map = {k: T @ self.views.poses[k] for k, T in T_new_old.items()}
        self._renderer.forget()
        self.gaussians.move_anchors(T_new_old)
        self.offloaded.move_anchors(T_new_old)
        self.views.poses.update(T_map)
        self._published.move(T_map)

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """Return a copy of the state; keyframe images and offloaded Gaussians stay in files."""
        return {
            "map": self.gaussians.snapshot(),
            "sleeping": self.offloaded.snapshot(),
            "optimizer": self.fitting.snapshot(),
            "views": self.views.snapshot(),
            "published": self._published.snapshot(),
            "newest": self._newest,
            "iterations": self.fitting.iterations,
        }

    def restore(self, state: Mapping[str, Any]) -> None:
        """Restore the state of a snapshot. The whole map then counts as published."""
        self.gaussians = GaussianMap.restore(state["map"])
        self.fitting.restore(state["optimizer"], state["iterations"])
        self.views.restore(state["views"])
        self.offloaded.restore(state["sleeping"])
        self._published.restore(self.views.cameras, state["published"])
        self._newest = state["newest"]
        self._renderer.forget()
        self._log.mark_all_published(self.gaussians)

    def metrics(self) -> dict[str, float]:
        return {
            "gaussians": len(self.gaussians),
            "gaussians_max": self.config.offload.max_active,  # More are offloaded to disk.
            "gaussians_pruned": self._pruned,
            "iterations": self.fitting.iterations,
            # Chosen keyframes that may see offloaded Gaussians, or whose images are unreadable.
            "keyframes_skipped": self.fitting.unusable,
            **self.fitting.device.metrics(),
            # Gaussians in memory beyond the limit, because recent keyframes may see them.
            "gaussians_over_limit": self._excess,
            **self.offloaded.metrics(),
            **self.views.store.metrics(),
        }
