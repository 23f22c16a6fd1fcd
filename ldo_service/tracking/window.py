"""A new keyframe measured against earlier ones. Conventions: `ldo_service.geometry`.

One chain of measurements, each keyframe from the one before, adds up its errors. The last
keyframes show much of the same surface, so each new one is measured from several of them: a band
of measurements that the optimizer solves together. On `synthetic:flat-exact` the error of the
trajectory falls to under half.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .alignment import AlignConfig, Alignment, BrightnessModel, align
from .keyframe_database import KeyframeRecord
from .keyframes import ReferenceKeyframe
from .pyramid import PyramidConfig


@dataclass(frozen=True, slots=True)
class WindowConfig:
    measurements: int = 3  # more per keyframe change little and cost 4 ms each; 0: none
    reach: int = 6  # of the last keyframes, which are tried newest first
    min_overlap: float = 0.35  # of the older keyframe's surface; less is mostly its edges
    worst_noise: float = 1.5  # times that of tracking: a poorer fit is left out
    levels: int = 2  # the finest: the guess is good
    iterations: tuple[int, ...] = (10, 4)  # at most, per level, the finest first

    def __post_init__(self) -> None:
        if self.measurements < 0 or min(self.reach, self.levels) < 1:
            raise ConfigError(
                named(self, "measurements", "reach", "levels")
                + ": measurements may be 0, reach and levels at least 1."
            )
        if not (0 < self.min_overlap <= 1 and self.worst_noise >= 1):
            raise ConfigError(
                named(self, "min_overlap", "worst_noise")
                + ": min_overlap must be within 0..1, worst_noise at least 1."
            )
        if not self.iterations or min(self.iterations) < 1:
            raise ConfigError(f"iterations={self.iterations}: at least 1 for each level.")


class RecentKeyframeCache:
    """The last keyframes from their places, each rebuilt once and kept while it is among them."""

    def __init__(self, config: PyramidConfig) -> None:
        self._config = config
        self._rebuilt: dict[int, tuple[KeyframeRecord, ReferenceKeyframe]] = {}

    def newest_first(
        self, places: Sequence[KeyframeRecord], reach: int
    ) -> Iterator[ReferenceKeyframe]:
        """The last `reach` of places, which come oldest first."""
        last = places[-reach:]
        ids = {place.id for place in last}
        self._rebuilt = {number: k for number, k in self._rebuilt.items() if number in ids}
        for place in reversed(last):
            known = self._rebuilt.get(place.id)
            if known is None or known[0] is not place:
                known = self._rebuilt[place.id] = place, place.keyframe(self._config)
            yield known[1]


def measure_against(
    earlier: Iterable[ReferenceKeyframe],
    keyframe: ReferenceKeyframe,
    usual: BrightnessModel,
    align_config: AlignConfig,
    config: WindowConfig,
) -> list[RelativePose]:
    """The pose of `keyframe` in the first ones of `earlier` that show the same surface.

    usual  how tracking sees just now: its noise starts each alignment, and judges it
    """
    measure = replace(align_config, start=usual, iterations=config.iterations)
    poses: list[RelativePose] = []
    for other in earlier:
        if len(poses) == config.measurements:
            break
        alignment = _aligned(other, keyframe, measure, config.levels)
        if _is_sure(alignment, usual, config):
            T_other_keyframe, information = alignment.T_reference_camera, alignment.information
            poses.append(RelativePose(other.id, keyframe.id, T_other_keyframe, information))
    return poses


def _aligned(
    other: ReferenceKeyframe, keyframe: ReferenceKeyframe, config: AlignConfig, levels: int
) -> Alignment:
    reference = replace(other.reference, points=other.reference.points[:levels])
    guess = se3.inverse(keyframe.T_odom_keyframe) @ other.T_odom_keyframe
    return align(reference, keyframe.view, guess, config)


def _is_sure(alignment: Alignment, usual: BrightnessModel, config: WindowConfig) -> bool:
    return (
        alignment.converged
        and alignment.overlap >= config.min_overlap
        and alignment.intensity_sigma <= config.worst_noise * usual.intensity_sigma
        and alignment.depth_noise_scale <= config.worst_noise * usual.depth_noise_scale
    )
