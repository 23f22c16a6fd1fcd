"""Relative-pose measurements of a new keyframe from earlier ones.

If each keyframe were measured relative to the previous one alone, errors would accumulate. The last
keyframes show much of the surface that a new keyframe shows, so the new one is measured relative to
several of them. The pose-graph optimizer combines these measurements. On the sequence
`synthetic:flat-exact`, this reduces the trajectory error to less than half.
Conventions: `ldo_service.geometry`.
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import se3
from ldo_service.geometry.keyframe_poses import RelativePose

from .aligner import CPU_ALIGNER, Aligner
from .alignment import AlignConfig, Alignment, BrightnessModel
from .keyframe_database import KeyframeRecord
from .keyframes import ReferenceKeyframe
from .pyramid import PyramidConfig


@dataclass(frozen=True, slots=True)
class WindowConfig:
    """Settings for measuring a new keyframe relative to earlier keyframes."""

    # Maximum number of measurements per keyframe; 0: none. A larger number changes the result
    # little, and each measurement takes 4 ms.
    measurements: int = 3
    reach: int = 6  # Number of the last keyframes to try, newest first.
    # Minimum overlap with the older keyframe; a smaller overlap consists mostly of image borders.
    min_overlap: float = 0.35
    # Maximum noise of a measurement, as a multiple of the noise of tracking.
    max_noise: float = 1.5
    # Number of finest pyramid levels to use. Coarse levels are not needed, as the initial guess is
    # good.
    levels: int = 2
    iterations: tuple[int, ...] = (10, 4)  # Maximum per level, the finest first.

    def __post_init__(self) -> None:
        if self.measurements < 0 or min(self.reach, self.levels) < 1:
            raise ConfigError(
                named(self, "measurements", "reach", "levels")
                + ": measurements must be at least 0; reach and levels must be at least 1."
            )
        if not (0 < self.min_overlap <= 1 and self.max_noise >= 1):
            raise ConfigError(
                named(self, "min_overlap", "max_noise")
                + ": min_overlap must be above 0 and at most 1, and max_noise must be at least 1."
            )
        if not self.iterations or min(self.iterations) < 1:
            raise ConfigError(
                f"WindowConfig.iterations={self.iterations} must have at least 1 iteration for "
                "each level."
            )


class RecentKeyframeCache:
    """Cache of the last keyframes, each rebuilt once from its record."""

    def __init__(self, config: PyramidConfig) -> None:
        self._config = config
        self._rebuilt: dict[int, tuple[KeyframeRecord, ReferenceKeyframe]] = {}

    def newest_first(
        self, records: Sequence[KeyframeRecord], reach: int
    ) -> Iterator[ReferenceKeyframe]:
        """Iterate over the last keyframes, newest first.

        Args:
            records: Keyframe records, oldest first.
            reach: Maximum number of keyframes.
        """
        last = records[-reach:]
        ids = {record.id for record in last}
        self._rebuilt = {number: k for number, k in self._rebuilt.items() if number in ids}
        for record in reversed(last):
            known = self._rebuilt.get(record.id)
            if known is None or known[0] is not record:
                known = self._rebuilt[record.id] = record, record.keyframe(self._config)
            yield known[1]


def measure_against(
    earlier: Iterable[ReferenceKeyframe],
    keyframe: ReferenceKeyframe,
    usual: BrightnessModel,
    align_config: AlignConfig,
    config: WindowConfig,
    aligner: Aligner = CPU_ALIGNER,
) -> list[RelativePose]:
    """Measure the pose of a new keyframe relative to earlier ones that show the same surface.

    Args:
        earlier: Earlier keyframes in order of preference.
        keyframe: The new keyframe.
        usual: Brightness change and residual noise of the tracked frame. Each alignment starts from
            these values. A measurement may have at most `config.max_noise` times this noise.
        align_config: Settings of alignment.
        config: Settings of the measurements.
        aligner: Aligner on the CPU or on a GPU.

    Returns:
        At most `config.measurements` relative poses.
    """
    measure = replace(align_config, start=usual, iterations=config.iterations)
    poses: list[RelativePose] = []
    for other in earlier:
        if len(poses) == config.measurements:
            break
        alignment = _aligned(other, keyframe, measure, config.levels, aligner)
        if _is_sure(alignment, usual, config):
            T_other_keyframe, information = alignment.T_reference_camera, alignment.information
            poses.append(RelativePose(other.id, keyframe.id, T_other_keyframe, information))
    return poses


def _aligned(
    other: ReferenceKeyframe,
    keyframe: ReferenceKeyframe,
    config: AlignConfig,
    levels: int,
    aligner: Aligner,
) -> Alignment:
    reference = replace(other.reference, points=other.reference.points[:levels])
    guess = se3.inverse(keyframe.T_odom_keyframe) @ other.T_odom_keyframe
    return aligner.align(reference, keyframe.view, guess, config)


def _is_sure(alignment: Alignment, usual: BrightnessModel, config: WindowConfig) -> bool:
    return (
        alignment.converged
        and alignment.overlap >= config.min_overlap
        and alignment.intensity_sigma <= config.max_noise * usual.intensity_sigma
        and alignment.depth_noise_scale <= config.max_noise * usual.depth_noise_scale
    )
