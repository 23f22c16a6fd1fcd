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
    """Addition of new Gaussians."""

    # Maximum side of an image cell that gets one Gaussian, pixels. Flat surfaces have cells of this
    # size. A value of 2 improves PSNR by 0.4 dB and makes twice as many Gaussians.
    max_cell_px: PositiveInt = 4
    # Transmittance above which a pixel gets a new Gaussian. A value of 0.5 lowers PSNR by 0.5 dB
    # and saves 4 % of the Gaussians.
    max_transmittance: OpenRatio = advanced(0.3)

    def __post_init__(self) -> None:
        if self.max_cell_px & (self.max_cell_px - 1):
            raise ConfigError(
                f"mapper.densify.max_cell_px={self.max_cell_px} must be a power of 2."
            )


@dataclass(frozen=True, slots=True)
class LearningRateSettings:
    """Learning rates of Adam per iteration, 5 to 10 times those of 3DGS."""

    # Learning rate of a center, meters. It is high, because a keyframe gets tens of iterations
    # instead of thousands.
    mean_m: NonNegativeFloat = advanced(5e-4)
    # Learning rate of the logarithm of a scale.
    log_scale: NonNegativeFloat = advanced(0.06)
    # Learning rate of a rotation quaternion.
    quaternion: NonNegativeFloat = advanced(0.01)
    # Learning rate of an opacity before the sigmoid.
    opacity_logit: NonNegativeFloat = advanced(0.1)
    # Learning rate of a color in 0..1.
    color: NonNegativeFloat = advanced(0.01)
    # Learning rate of keyframe rotations, radians. 0 does not change the rotations. A value of 2e-4
    # improves PSNR by 0.3 dB and adds 1 mm of noise to exact poses.
    pose_rotation_rad: NonNegativeFloat = advanced(0.0)
    # Learning rate of keyframe positions, meters. 0 does not change the positions.
    pose_translation_m: NonNegativeFloat = advanced(0.0)


@dataclass(frozen=True, slots=True)
class LossSettings:
    """Loss between a rendering and a keyframe."""

    # Weight of the color error, as in 3DGS (Kerbl et al. 2023, equation 7).
    l1: NonNegativeFloat = advanced(0.8)
    # Weight of D-SSIM, as in 3DGS.
    d_ssim: NonNegativeFloat = advanced(0.2)
    # Weight of the depth error per meter.
    depth: NonNegativeFloat = advanced(0.5)
    # Maximum standard deviation of a Gaussian in the image, pixels. Without a limit, one Gaussian
    # could cover a whole wall. A limit of 10 lowers PSNR by 0.6 dB.
    max_sigma_px: PositiveFloat = advanced(20.0)


@dataclass(frozen=True, slots=True)
class PruneSettings:
    """Removal of Gaussians."""

    # Minimum opacity. Gaussians with a lower opacity are removed, as in 3DGS (Kerbl et al. 2023,
    # section 5.2).
    min_opacity: Annotated[float, Meta(ge=0, lt=1)] = advanced(0.005)
    # Number of keyframes between prunings of the map.
    interval_keyframes: PositiveInt = advanced(5)


@dataclass(frozen=True, slots=True)
class KeyframeImageSettings:
    """Keyframe images that the Gaussian optimizer uses."""

    # Maximum size of keyframe images in memory, MB. The default holds 119 keyframes of 640x480 at
    # 2.15 MB each.
    memory_mb: NonNegativeFloat = 256.0
    # Maximum size of keyframe images on disk, MB. The default holds about 8,000 keyframes of
    # 640x480. Beyond this size, the images of the most redundant keyframes are deleted.
    disk_mb: PositiveFloat = 4096.0
    # Maximum number of keyframes with images on disk. Each of these keyframes takes 3 kB of memory,
    # independent of the size of its image.
    max_keyframes: PositiveInt = advanced(20_000)


@dataclass(frozen=True, slots=True)
class OffloadSettings:
    """Offloading of Gaussians to disk."""

    # Maximum number of Gaussians in memory. Beyond this number, Gaussians out of view are
    # offloaded to disk. The default number takes 300 MB with the moments of Adam.
    max_resident_gaussians: PositiveInt = 1_500_000


@dataclass(frozen=True, slots=True)
class SemanticsSettings:
    """Labels of Gaussians."""

    # Minimum fraction of a Gaussian that a region must cover to label the Gaussian. This is
    # theta_IoU (LDO-SLAM paper, III.A).
    min_overlap: Ratio = advanced(0.3)
    # Maximum number of names in the vocabulary. A further name becomes `other`.
    max_label_names: Annotated[int, Meta(ge=1, le=MAX_LABELS)] = advanced(MAX_LABELS)


@dataclass(frozen=True, slots=True)
class ObjectSettings:
    """Objects in the map."""

    # Number of keyframes that must observe a candidate before it becomes an object (LDO-SLAM paper,
    # III.C).
    min_observations: PositiveInt = 3
    # Maximum number of objects in the map. The default number takes 6 MB of memory, and a few
    # ms per keyframe if all objects are in view.
    max_objects: PositiveInt = 2000
    # Minimum IoU of the boxes of a detection and an object to associate the two (LDO-SLAM paper,
    # III.C).
    min_iou: PositiveRatio = advanced(0.4)
    # Number of consecutive keyframes that may miss a visible object before it is removed
    # (LDO-SLAM paper, III.C).
    max_misses: PositiveInt = advanced(10)


@dataclass(frozen=True, slots=True)
class OpenVocabularySettings:
    """Requests to the labeller for labels of image regions."""

    # Minimum score of a detection whose region needs no label from the labeller (LDO-SLAM paper,
    # III.B).
    confident_score: Ratio = advanced(0.6)
    # Average number of label requests per keyframe. The LDO-SLAM paper requests labels on 10 to
    # 25 % of the frames.
    requests_per_keyframe: PositiveFloat = advanced(2.5)
    # True counts detector boxes as votes for the label of a region. False leaves the label to the
    # labeller alone.
    detector_votes: bool = advanced(True)
    # Minimum confidence of a result of the labeller; results below it are not used. A value of 0.5
    # lowers the recall on synthetic:flat by 7 percentage points.
    min_confidence: Ratio = advanced(0.3)


@dataclass(frozen=True, slots=True)
class PublishSettings:
    """Publication of the map in messages."""

    # Minimum number of keyframes between two snapshots of the map, which limits the bandwidth.
    snapshot_interval_keyframes: PositiveInt = advanced(10)
    # Maximum number of Gaussians per message, so that a message does not delay others for long.
    # 16,384 Gaussians take 1.2 MB, or 1.8 MB with labels.
    max_gaussians_per_message: PositiveInt = advanced(16_384)
    # Number of keyframes between messages with changed old Gaussians. These Gaussians are not
    # sent at every keyframe, because each keyframe changes all Gaussians in view.
    update_interval_keyframes: PositiveInt = advanced(5)


@dataclass(frozen=True, slots=True)
class RefitSettings:
    """Refit of the map to keyframes that a correction has moved."""

    # Refit iterations for each keyframe that a correction displaces by more than 1 cm or 0.01 rad.
    # The displacement is relative to the oldest keyframe within the same cube of 2 m.
    iterations: NonNegativeInt = advanced(12)
    # Maximum number of pending refit iterations that run with each new keyframe, if no other
    # keyframe is queued. The others run while no keyframe arrives.
    iterations_per_keyframe: NonNegativeInt = advanced(6)


@dataclass(frozen=True, slots=True)
class MapperSettings:
    """Map of Gaussians and of objects."""

    # Computing time of the Gaussian optimizer for each keyframe, in units of one iteration at full
    # resolution. Most iterations use images of half the resolution and take less time, so about 35
    # iterations run with the default. It gives 12 frames per second on two cores at 640x480.
    iterations: NonNegativeInt = 12
    # Threads of the renderer. 0 uses as many as there are cores. The threads of the tracker have a
    # higher priority.
    threads: NonNegativeInt = 0
    # Minimum number of keyframes between checkpoints of the map. A map of more than 100,000
    # Gaussians has one keyframe more for each 20,000 Gaussians. After a crash, up to this many
    # keyframes are mapped again.
    checkpoint_interval_keyframes: PositiveInt = 5
    # Folder of the keyframe images. Empty uses the state folder, or a temporary folder
    # if there is no state folder.
    image_folder: str = advanced("")
    # Seed of the random choice of keyframes that are optimized.
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
