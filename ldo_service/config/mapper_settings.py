"""Settings of the mapper."""

from dataclasses import dataclass, field
from typing import Annotated

from msgspec import Meta

from ldo_service.errors import ConfigError
from ldo_service.semantics.gaussian_labels import MAX_LABELS

from .values import (
    NonNegativeFloat,
    NonNegativeInt,
    OpenRatio,
    PositiveFloat,
    PositiveInt,
    PositiveRatio,
    Ratio,
    advanced,
)


@dataclass(frozen=True, slots=True)
class DensifySettings:
    """Insertion of new Gaussians."""

    # Flat surface gets one Gaussian per cell of so many pixels a side. 2 gains 0.4 dB with twice
    # as many.
    max_cell_px: PositiveInt = 4
    # Pixels through which more light passes get new Gaussians. 0.5 costs 0.5 dB and saves 4 %.
    max_transmittance: OpenRatio = advanced(0.3)

    def __post_init__(self) -> None:
        if self.max_cell_px & (self.max_cell_px - 1):
            raise ConfigError(
                f"mapper.densify.max_cell_px={self.max_cell_px} must be a power of 2."
            )


@dataclass(frozen=True, slots=True)
class LearningRateSettings:
    """Step lengths of Adam per iteration, 5 to 10 times those of 3DGS."""

    # This is the step of a center in meters. A keyframe gets tens of iterations, not thousands.
    mean_m: NonNegativeFloat = advanced(5e-4)
    # This is the step of the logarithm of an axis.
    log_scale: NonNegativeFloat = advanced(0.06)
    # This is the step of a rotation.
    quaternion: NonNegativeFloat = advanced(0.01)
    # This is the step of an opacity before the sigmoid.
    opacity_logit: NonNegativeFloat = advanced(0.1)
    # This is the step of a color in 0..1.
    color: NonNegativeFloat = advanced(0.01)
    # The renderer turns keyframe poses by this step. 0 leaves them. 2e-4 gains 0.3 dB and adds 1 mm
    # of noise to exact poses.
    pose_rotation_rad: NonNegativeFloat = advanced(0.0)
    # The renderer moves keyframe poses by this step. 0 leaves them.
    pose_translation_m: NonNegativeFloat = advanced(0.0)


@dataclass(frozen=True, slots=True)
class LossSettings:
    """Loss between a rendering and a keyframe."""

    # This is the weight of the color error, as in 3DGS (Kerbl et al. 2023, equation 7).
    l1: NonNegativeFloat = advanced(0.8)
    # This is the weight of D-SSIM, as in 3DGS.
    d_ssim: NonNegativeFloat = advanced(0.2)
    # This is the weight of the depth error per meter.
    depth: NonNegativeFloat = advanced(0.5)
    # A Gaussian grows to this standard deviation at most, or one would cover a whole wall. 10 costs
    # 0.6 dB.
    max_sigma_px: PositiveFloat = advanced(20.0)


@dataclass(frozen=True, slots=True)
class PruneSettings:
    """Removal of Gaussians."""

    # Gaussians with a lower opacity are removed, as in 3DGS (Kerbl et al. 2023, section 5.2).
    min_opacity: Annotated[float, Meta(ge=0, lt=1)] = advanced(0.005)
    # The map is pruned every so many keyframes.
    interval_keyframes: PositiveInt = advanced(5)


@dataclass(frozen=True, slots=True)
class KeyframeImageSettings:
    """Images of keyframes that the map is fitted to."""

    # The memory holds images up to this size: 119 keyframes of 640x480 with 2.15 MB each.
    memory_mb: NonNegativeFloat = 256.0
    # The disk holds images up to this size: some 8,000 keyframes of 640x480. Then the most
    # redundant go.
    disk_mb: PositiveFloat = 4096.0
    # The disk holds so many keyframes, however small, because each takes 3 kB of memory.
    max_keyframes: PositiveInt = advanced(20_000)


@dataclass(frozen=True, slots=True)
class OffloadSettings:
    """Gaussians on disk."""

    # The memory holds so many Gaussians, 300 MB with their moments. Those out of view move to disk.
    max_resident_gaussians: PositiveInt = 1_500_000


@dataclass(frozen=True, slots=True)
class SemanticsSettings:
    """Labels of Gaussians."""

    # A Gaussian takes the label of a region that covers so much of it. This is theta_IoU (III.A).
    min_overlap: Ratio = advanced(0.3)
    # The vocabulary holds so many names. A later name becomes `other`.
    max_label_names: Annotated[int, Meta(ge=1, le=MAX_LABELS)] = advanced(MAX_LABELS)


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """Objects in the map."""

    # A candidate becomes an object when so many keyframes have seen it (III.C).
    min_observations: PositiveInt = 3
    # The map holds so many objects, 6 MB, and takes some ms per keyframe with all in view.
    max_objects: PositiveInt = 2000
    # A detection belongs to an object when their boxes overlap so much (III.C).
    min_iou: PositiveRatio = advanced(0.4)
    # An object is removed when so many keyframes in a row miss it although it is in view (III.C).
    max_misses: PositiveInt = advanced(10)


@dataclass(frozen=True, slots=True)
class OpenVocabularySettings:
    """Regions that the labeller is asked about."""

    # A region that the detector is less sure of goes to the labeller (III.B).
    confident_score: Ratio = advanced(0.6)
    # The labeller gets so many requests per keyframe on average. The paper asks on 10 to 25 % of
    # the frames.
    requests_per_keyframe: PositiveFloat = advanced(2.5)
    # Boxes of the detector vote for the name of a region. False leaves it to the labeller alone.
    detector_votes: bool = advanced(True)
    # A less certain answer is ignored. 0.5 costs 7 points of recall on the flat.
    min_confidence: Ratio = advanced(0.3)


@dataclass(frozen=True, slots=True)
class PublishSettings:
    """Messages of the map."""

    # A snapshot of the map is sent after so many keyframes at the earliest, which bounds the
    # bandwidth.
    snapshot_interval_keyframes: PositiveInt = advanced(10)
    # One message carries so many Gaussians, 1.2 MB or 1.8 MB with labels, so that it blocks no
    # other for long.
    max_gaussians_per_message: PositiveInt = advanced(16_384)
    # Changes of old Gaussians are sent every so many keyframes, because each keyframe changes all
    # in view.
    update_interval_keyframes: PositiveInt = advanced(5)


@dataclass(frozen=True, slots=True)
class RefitSettings:
    """Fit of the map to keyframes that a correction has moved."""

    # A keyframe that moves over 1 cm against the first is fitted again with so many iterations.
    iterations: NonNegativeInt = advanced(12)
    # Each new keyframe pays for so many of these iterations while no other waits.
    iterations_per_keyframe: NonNegativeInt = advanced(6)


@dataclass(frozen=True, slots=True)
class MapperSettings:
    """Map of Gaussians and of objects."""

    # The map is fitted to each keyframe with so many iterations: 12 frames per second on two cores
    # at 640x480.
    iterations: NonNegativeInt = 12
    # The renderer uses so many threads. 0 takes all cores but one, which the tracker needs.
    threads: NonNegativeInt = 0
    # The map is saved every so many keyframes. After a crash so many are mapped again.
    checkpoint_interval_keyframes: PositiveInt = 5
    # Images of keyframes are kept in this folder. Empty takes a temporary one, or the state's.
    image_folder: str = advanced("")
    # This seed decides which keyframes the map is fitted to.
    seed: NonNegativeInt = advanced(0)
    densify: DensifySettings = field(default_factory=DensifySettings)
    learning_rate: LearningRateSettings = field(default_factory=LearningRateSettings)
    loss: LossSettings = field(default_factory=LossSettings)
    prune: PruneSettings = field(default_factory=PruneSettings)
    keyframe_images: KeyframeImageSettings = field(default_factory=KeyframeImageSettings)
    offload: OffloadSettings = field(default_factory=OffloadSettings)
    semantics: SemanticsSettings = field(default_factory=SemanticsSettings)
    objects: ObjectSettings = field(default_factory=ObjectSettings)
    open_vocabulary: OpenVocabularySettings = field(default_factory=OpenVocabularySettings)
    publish: PublishSettings = field(default_factory=PublishSettings)
    refit: RefitSettings = field(default_factory=RefitSettings)
