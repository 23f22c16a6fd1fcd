"""How keyframes become a map: grown where it lacks something, fitted to a window, bounded."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from math import inf
from pathlib import Path
from typing import Any

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, RgbdFrame, se3
from ldo_service.geometry.point_records import PoseTable

from .change_log import ChangeLog, Changes
from .densification import DensificationConfig, densify
from .exposure import Exposure, estimate_exposure
from .fitting import Fitting, ViewSamplingConfig, random_for
from .keyframe_store import KeyframeStore, KeyframeStoreConfig, KeyframeViews
from .model import GaussianBatch, GaussianMap
from .offloading import OffloadedGaussians, iter_all_gaussians
from .optimizer import GaussianOptimizerConfig
from .pruning import DeduplicationConfig, PruningConfig, find_duplicates, prunable_mask
from .renderer import Contributions, Rendering, RenderMemory, render
from .training_views import TrainingView, visible_in_mask
from .visibility import (
    BoundingSpheres,
    MaxDepthGrid,
    OffloadConfig,
    PlacedCamera,
    chunk_numbers,
    plan_offload,
)

MAX_ITERATIONS_PER_EFFORT = 2  # iterations that count as one when they reach next to nothing


@dataclass(frozen=True, slots=True)
class MapBuilderConfig:
    insertion: DensificationConfig = field(default_factory=DensificationConfig)
    optimiser: GaussianOptimizerConfig = field(default_factory=GaussianOptimizerConfig)
    window: ViewSamplingConfig = field(default_factory=ViewSamplingConfig)
    pruning: PruningConfig = field(default_factory=PruningConfig)
    merging: DeduplicationConfig = field(default_factory=DeduplicationConfig)
    store: KeyframeStoreConfig = field(default_factory=KeyframeStoreConfig)
    sleep: OffloadConfig = field(default_factory=OffloadConfig)
    recent_cameras: int = 8  # what the last keyframes see stays awake
    prune_keyframes: int = 5  # between two prunings
    refined_m: float = 2e-4  # a keyframe that the optimiser moved by so much, or
    refined_rad: float = 2e-4  # turned by so much, is told of
    seed: int = 0  # of the choice of keyframes

    def __post_init__(self) -> None:
        if self.prune_keyframes < 1 or min(self.refined_m, self.refined_rad, self.seed) < 0:
            raise ConfigError(
                named(self, "prune_keyframes", "refined_m", "refined_rad", "seed")
                + ": prune_keyframes at least 1, the others not negative."
            )


class MapBuilder:
    """The map and all that is needed to go on with it.

    Deterministic: the same keyframes, corrections and iterations in the same order give the same
    bits, for any number of threads and after `restore`. Not for two threads at once.
    """

    def __init__(
        self,
        config: MapBuilderConfig | None = None,
        *,
        folder: Path | None = None,
        threads: int = 1,
    ) -> None:
        """Images of keyframes and sleeping Gaussians go to `folder`, or to a temporary one."""
        self.config = config or MapBuilderConfig()
        self.gaussians = GaussianMap()
        self.sleeping = OffloadedGaussians(folder and folder / "gaussians")
        self.views = KeyframeViews(KeyframeStore(folder and folder / "images", self.config.store))
        self._threads, self._memory = threads, RenderMemory()
        self._fitting = Fitting(
            self.config.optimiser,
            self.config.window,
            self.views,
            self.is_resident,
            seed=self.config.seed,
            threads=threads,
        )
        self._log = ChangeLog()
        self._told = PoseTable()  # T_map_keyframe that others know, of those with images
        self._newest: int | None = None
        self._shown: tuple[int, Rendering] | None = None  # of a keyframe, while the map stays
        self._pruned = self._excess = 0

    # --- keyframes --------------------------------------------------------------------------------
    def add(
        self,
        frame: RgbdFrame,
        T_map_camera: np.ndarray,
        keyframe: int,
        iterations: int,
        dynamic_mask: np.ndarray | None = None,
    ) -> None:
        """Take in a keyframe, later than all before, and fit the map to its window.

        T_map_camera [4, 4]; `iterations` of the optimiser that reach the usual number of Gaussians:
        fewer where more are in view, so that a keyframe costs the same however dense the map is;
        `dynamic_mask` [H, W] bool: pixels that are neither mapped nor fitted.
        Its Gaussians hang on it.
        """
        self._wake(PlacedCamera(frame.camera, T_map_camera, MaxDepthGrid.of(frame.depth_m)))
        self._shown = None
        before = self.render_from(frame.camera, T_map_camera)
        exposure = self._exposure(frame, before, dynamic_mask)
        self._insert(frame, T_map_camera, keyframe, before, exposure, dynamic_mask)
        counts = None if dynamic_mask is None else (~dynamic_mask).astype(np.uint8)
        view = replace(
            TrainingView.of(frame, T_map_camera, keyframe), exposure=exposure, mask=counts
        )
        self._told[keyframe], self._newest = T_map_camera, keyframe
        for forgotten in self.views.add(view):
            del self._told[forgotten]
            self._fitting.forget_view(forgotten)
        plan = self._fitting.plan(view, MAX_ITERATIONS_PER_EFFORT * iterations)
        touched = self._fit(plan, effort=iterations)
        if len(self.views) % self.config.prune_keyframes == 0:
            self._prune_misshapen(touched)
        self._prune_unconfirmed(keyframe)

    def render_from(
        self, camera: Camera, T_map_camera: np.ndarray, *, contributions: bool = False
    ) -> Rendering:
        """What the map shows there, of what is awake."""
        return render(
            self.gaussians.rows,
            camera,
            se3.inverse(T_map_camera),
            bounds=self.gaussians.bounds,
            memory=self._memory,
            contributions=contributions,
            threads=self._threads,
        )

    def render_keyframe(self, keyframe: int, *, contributions: bool = False) -> Rendering:
        """What it shows where a keyframe stands; rendered once while the map does not change."""
        if self._shown is None or self._shown[0] != keyframe:
            self._shown = None
        if self._shown is None or (contributions and self._shown[1].contributions is None):
            camera, pose = self.views.cameras[keyframe], self.views.poses[keyframe]
            self._shown = keyframe, self.render_from(camera, pose, contributions=contributions)
        return self._shown[1]

    def _exposure(
        self, frame: RgbdFrame, before: Rendering, dynamic_mask: np.ndarray | None
    ) -> Exposure:
        """Against the map; where too little of it is in view, as the keyframe before."""
        rendered, seen = before.color.transpose(2, 0, 1), frame.color.transpose(2, 0, 1)
        counts = None if dynamic_mask is None else (~dynamic_mask).astype(np.uint8)
        estimated = estimate_exposure(rendered, before.opacity, seen, counts)
        if estimated is not None or self._newest is None:
            return estimated or Exposure()
        return self.views.exposures[self._newest]

    def _insert(
        self,
        frame: RgbdFrame,
        T_map_camera: np.ndarray,
        keyframe: int,
        before: Rendering,
        exposure: Exposure,
        dynamic_mask: np.ndarray | None,
    ) -> None:
        color = exposure.removed(frame.color * np.float32(1 / 255))
        densify(
            self.gaussians,
            replace(frame, color=(255 * color + 0.5).astype(np.uint8)),
            T_map_camera,
            keyframe,
            self.config.insertion,
            before=before,
            left_out=dynamic_mask,
            threads=self._threads,
        )
        self._log.mark_added(self.gaussians)

    def remove_masked(self, keyframe: int, pixels: np.ndarray) -> int:
        """What a keyframe shows there, [H, W] bool, turned out not to belong to the map: it is
        fitted no more, and the Gaussians that the keyframe put there go. How many did.

        Raises KeyError for a keyframe without images.
        """
        self._wake(self.views.placed(keyframe))
        self._shown = None
        self.views.mask_pixels(keyframe, pixels)
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
        """Fit to random keyframes, with steps that shrink or grow from one rate to the other; until
        all of `first` are through, to one of them and one at random in turn. How many iterations it
        were: fewer where `effort` was spent, or where most keyframes see what sleeps.
        """
        self._shown, before = None, self._fitting.iterations
        self._fit(self._fitting.plan_refinement(iterations, first), rates, effort)
        return self._fitting.iterations - before

    def _fit(
        self, plan: Iterable[int], rates: tuple[float, float] = (1.0, 1.0), effort: float = inf
    ) -> np.ndarray:
        touched = self._fitting.fit(self.gaussians, plan, rates, effort)
        self._log.changed(touched)
        return touched

    def is_resident(self, keyframe: int) -> bool:
        """Whether all is awake that it may see: else what is would be bent to stand in for it."""
        return not self.sleeping.visible_chunks(self.views.placed(keyframe), self._reach_m)

    # --- after a correction -----------------------------------------------------------------------
    def deduplicate_keyframe(self, keyframe: int, iterations: int) -> int:
        """A keyframe that was laid over earlier ones: what the map holds twice there is held once,
        and a few iterations fit it to the keyframe. How many Gaussians went; none where its images
        are forgotten.

        One keyframe at a time, so that nobody waits long.
        """
        if keyframe not in self.views.cameras:
            return 0
        self._shown = None
        self._wake(self.views.placed(keyframe))
        mask = find_duplicates(
            self.gaussians.rows, self.gaussians.anchors, keyframe, self.config.merging
        )
        self._remove(mask)
        self._fit([keyframe] * iterations)
        return int(np.count_nonzero(mask))

    # --- pruning ----------------------------------------------------------------------------------
    def _prune_misshapen(self, touched: np.ndarray) -> None:
        """Among those that the window reached, so that it costs no more in a larger map."""
        among = np.flatnonzero(touched)
        mask = np.zeros(len(self.gaussians), bool)
        mask[among] = prunable_mask(self.gaussians.rows[among], self.config.pruning)
        self._remove(mask)

    def _prune_unconfirmed(self, newest: int) -> None:
        """Of the Gaussians of two keyframes: of one that others have followed by now, and of an
        earlier one, at random, since the map goes on changing around it."""
        age, pruning = self.config.pruning.confirm_keyframes, self.config.pruning
        older = [k for k in self.views.store.keyframes() if k < newest][: 1 - age or None]
        if not older or pruning.min_weight_px == 0:
            return
        chosen = {
            older[-1],
            older[int(random_for(self.config.seed, newest, 1).integers(len(older)))],
        }
        shown = np.zeros(len(self.gaussians), np.float32)
        for keyframe in (newest, *sorted(chosen)):
            made_by = self._contributions(keyframe)
            shown[made_by.indices] = np.maximum(shown[made_by.indices], made_by.weights)
        is_theirs = np.isin(self.gaussians.anchors, list(chosen))
        self._remove(is_theirs & (shown < pruning.min_weight_px))

    def _contributions(self, keyframe: int) -> Contributions:
        camera, pose = self.views.cameras[keyframe], self.views.poses[keyframe]
        shown = self.render_from(camera, pose, contributions=True).contributions
        assert shown is not None
        return shown

    def _remove(self, mask: np.ndarray) -> None:
        self._log.mark_removed(self.gaussians, mask)
        self._pruned += self.gaussians.remove(mask)

    # --- labels -----------------------------------------------------------------------------------
    def visible_contributions(self, keyframe: int) -> Contributions:
        """The Gaussians that make its image, woken if they slept."""
        self._wake(self.views.placed(keyframe))
        shown = self.render_keyframe(keyframe, contributions=True).contributions
        assert shown is not None
        return shown

    def mark_relabeled(self, indices: np.ndarray) -> None:
        """These rows have other labels than followers know."""
        mask = np.zeros(len(self.gaussians), bool)
        mask[indices] = True
        self._log.changed(mask)

    # --- sleep ------------------------------------------------------------------------------------
    @property
    def _reach_m(self) -> float:
        return self.config.sleep.reach_m

    def _wake(self, camera: PlacedCamera) -> None:
        seen = self.sleeping.visible_chunks(camera, self._reach_m)
        ids = self.sleeping.load_into(self.gaussians, seen)
        if len(ids):
            self._shown = None
        self._log.mark_loaded(self.gaussians, ids)

    def offload_excess(self) -> None:
        """Let Gaussians sleep where there are too many. To be called when followers know all that
        changed: to them sleeping Gaussians are as before."""
        if len(self.gaussians) <= self.config.sleep.max_active:
            return
        keyframes = list(self.views.cameras)[-self.config.recent_cameras :]
        recent = [self.views.placed(keyframe) for keyframe in keyframes]
        rows, anchors = self.gaussians.rows, self.gaussians.anchors
        clumps = chunk_numbers(self.gaussians.means, anchors, self.config.sleep.clump_m)
        awake = BoundingSpheres.around(rows, anchors, clumps)
        choice = plan_offload(awake, recent, self.config.sleep)
        self._excess = choice.excess
        self.sleeping.offload_from(self.gaussians, clumps, choice.clumps)
        self._shown = None
        self._log.mark_all_published(self.gaussians)

    def size(self) -> int:
        """Gaussians, awake and asleep."""
        return len(self.gaussians) + len(self.sleeping)

    def batches(self) -> Iterator[GaussianBatch]:
        """The whole map, in pieces; ids ascend throughout."""
        yield from iter_all_gaussians(self.gaussians, self.sleeping)

    # --- telling others ---------------------------------------------------------------------------
    def changes(self, *, with_changed: bool) -> Changes:
        """What followers of the map do not know yet; see `ChangeLog.drain`."""
        self._log.lost(self.sleeping.pop_lost_ids(self.gaussians))
        return self._log.drain(self.gaussians, with_changed=with_changed)

    def refined(self) -> dict[int, np.ndarray]:
        """T_map_keyframe of keyframes that the optimiser moved since others were told."""
        poses = self.views.poses
        is_news = se3.transforms_differ(
            poses.of(self._told),
            self._told.of(self._told),
            self.config.refined_m,
            self.config.refined_rad,
        )
        moved = {k: poses[k] for k, is_new in zip(self._told, is_news, strict=True) if is_new}
        self._told.update(moved)
        return moved

    def move(self, T_new_old: Mapping[int, np.ndarray]) -> None:
        """Keyframes were corrected: what hangs on each goes with it, and its view."""
        T_map = {k: T @ self.views.poses[k] for k, T in T_new_old.items()}
        self._shown = None
        self.gaussians.move_anchors(T_new_old)
        self.sleeping.move(T_new_old)
        self.views.poses.update(T_map)
        self._told.update({k: T for k, T in T_map.items() if k in self._told})

    # --- state ------------------------------------------------------------------------------------
    def snapshot(self) -> dict[str, Any]:
        """A copy of everything but the images in the store."""
        return {
            "map": self.gaussians.snapshot(),
            "sleeping": self.sleeping.snapshot(),
            "optimiser": self._fitting.snapshot(),
            "views": self.views.snapshot(),
            "told": self._told.of(self._told),
            "newest": self._newest,
            "iterations": self._fitting.iterations,
        }

    def saved(self) -> None:
        """The last snapshot is where a successor will find it."""
        self.sleeping.saved()

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go on from a snapshot: followers are taken to know the whole map."""
        self.gaussians = GaussianMap.restore(state["map"])
        self._fitting.restore(state["optimiser"], state["iterations"])
        self.views.restore(state["views"])
        self.sleeping.restore(state["sleeping"])
        self._told.become(self.views.cameras, state["told"])
        self._newest, self._shown = state["newest"], None
        self._log.mark_all_published(self.gaussians)

    def metrics(self) -> dict[str, float]:
        return {
            "gaussians": len(self.gaussians),
            "gaussians_pruned": self._pruned,
            "iterations": self._fitting.iterations,
            "keyframes_skipped": self._fitting.unusable,  # chosen; gone, or see what sleeps
            "gaussians_over_limit": self._excess,  # they may be looked at, so they do not sleep
            **self.sleeping.metrics(),
            **self.views.store.metrics(),
        }
