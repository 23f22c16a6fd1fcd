"""Settings of the densification."""

from dataclasses import dataclass
from math import inf

from ldo_service.errors import ConfigError

# The renderer adds 0.3 px^2 to the variance of every splat. Densification subtracts this much of
# it from the variance of a new Gaussian. A larger value gives sharper images. With the full 0.3,
# cracks appear between Gaussians from one-pixel cells when the camera comes nearer.
LOW_PASS_COMPENSATION_PX2 = 0.2


@dataclass(frozen=True, slots=True)
class DensificationConfig:
    """Settings of the densification.

    Comments of the settings give changes of the PSNR in dB if a setting differs from its default.
    The defaults reach 28.2 dB. All values were measured on 75 frames of a Replica apartment with
    ground-truth poses. Every 5th frame was densified, and PSNR was measured on the other frames.
    The Gaussians were not optimized, and pixels without opacity were excluded. The defaults were
    chosen on the same frames.
    """

    # Criteria by which the map explains a pixel (LDO-SLAM paper, III.A).
    # A pixel with more transmittance is unexplained. 0.5: -0.5 dB, 4 % fewer Gaussians.
    max_transmittance: float = 0.3
    # A pixel shows new surface if its depth is less than the rendered depth by more than this
    # fraction of the rendered depth.
    in_front: float = 0.05
    # A nearer surface is not new if the map shows it within this many pixels, because depth is
    # noisy at edges. With 0, each further lap through an apartment adds 5 % Gaussians although the
    # poses are exact, and the sequence kitchen loses 0.7 dB.
    edge_px: int = 2
    # A pixel is unexplained if its color error, averaged over the channels, exceeds this, 0..1.
    # The default turns this criterion off, because colors are not optimized yet when a keyframe is
    # densified. 0.1 gives +0.3 dB for +57 % Gaussians, but adds Gaussians again at every visit:
    # densifying the same 5 frames six times increases the map from 101 k to 369 k Gaussians. With
    # the criterion off, the map stays at 79 k.
    max_color_error: float = inf
    overlap_px: int = 2  # Margin around unexplained pixels; it closes seams. 0: -1.2 dB.
    # Pixels without depth get the farthest depth within this many pixels. Holes that stay black
    # limit the PSNR.
    hole_px: int = 4

    # Placement of the Gaussians.
    # Side of the largest cells: uniform areas get one Gaussian per 4x4 pixels. A side of 2 gives
    # 0.4 dB more, and twice as many Gaussians.
    coarsest_px: int = 4
    # Largest contrast of one cell and its rim, 0..1. 0.2 gives 30 % more Gaussians, and no better
    # image once they are optimized.
    max_contrast: float = 0.3
    # Largest depth difference in one cell, as a fraction of the largest depth in it. A larger
    # difference means several surfaces.
    max_depth_step: float = 0.05

    # Shape and color of the Gaussians.
    # Standard deviation as a fraction of the cell's side. 0.5: cracks, -2.0 dB; 0.7: blur, -0.6 dB.
    sigma_per_spacing: float = 0.6
    # Standard deviation along the normal as a fraction of the one across the slope; values from
    # 0.03 to 0.3 look the same.
    thickness: float = 0.1
    # Largest stretch down a slope, about 1 / cos(75 deg). Normals of steeper slopes are unreliable.
    max_stretch: float = 4.0
    opacity: float = 0.95  # 0.9: -0.2 dB, and dark grids on walls when the camera comes nearer.
    # Number of color corrections by the difference of frame and rendering. 0: -1.1 dB; 3: -0.4 dB
    # (overfits).
    color_steps: int = 1
    # Largest correction of a color channel, 0..1. Older Gaussians cause the larger differences.
    max_color_step: float = 0.1

    def __post_init__(self) -> None:
        if self.coarsest_px < 1 or self.coarsest_px & (self.coarsest_px - 1):
            raise ConfigError(
                f"DensificationConfig.coarsest_px={self.coarsest_px} must be a power of 2."
            )
        for name in ("max_transmittance", "in_front", "opacity", "thickness"):
            if not 0 < getattr(self, name) < 1:
                raise ConfigError(
                    f"DensificationConfig.{name}={getattr(self, name)} must lie between 0 and 1."
                )
        for name in (
            "edge_px",
            "overlap_px",
            "hole_px",
            "color_steps",
            "max_contrast",
            "max_depth_step",
            "max_color_step",
        ):
            if not getattr(self, name) >= 0:
                raise ConfigError(
                    f"DensificationConfig.{name}={getattr(self, name)} must not be negative."
                )
        if not self.sigma_per_spacing**2 > LOW_PASS_COMPENSATION_PX2:
            raise ConfigError(
                f"DensificationConfig.sigma_per_spacing={self.sigma_per_spacing} must exceed 0.45: "
                "a smaller splat has no variance left after compensation of the low-pass filter."
            )
        if not self.max_stretch >= 1:
            raise ConfigError(
                f"DensificationConfig.max_stretch={self.max_stretch} must be at least 1."
            )
