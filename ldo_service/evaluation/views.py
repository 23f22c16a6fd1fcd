"""Comparison of the frames of a run with renderings of its map at the same poses."""

from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from ldo_service.calibration.correction import CameraCorrection
from ldo_service.calibration.shutter import FrameMotion
from ldo_service.gaussians.exposure import Exposure, fit_exposure
from ldo_service.gaussians.renderer import Rendering, render
from ldo_service.geometry import RgbdFrame, se3, valid_pixels
from ldo_service.geometry.sequence import Sequence

from .finished_run import PosedMap, RunFrame

WINDOW_PX, SIGMA_PX = 11, 1.5  # Wang et al., 2004, section III.B.
C1, C2 = 0.01**2, 0.03**2  # Constants of the same source, for images in 0..1.
COVERED = 0.5  # Rendered opacity above which there is a surface to compare.

TRAINING_STEP = 5  # Protocol B uses every fifth training frame (SplaTAM, Keetha et al., 2024).
FIGURES = ("psnr_db", "ssim", "lpips", "depth_l1_m", "depth_share")

PROTOCOL = """\
Maps are rendered at the poses that the run ended with, and compared with the rectified frames of
the run. Colors are in 0..1; renderings are clipped. PSNR: over all pixels and channels of a frame.
SSIM: Wang et al. 2004, Gaussian window of 11x11 pixels and sigma 1.5 px, over windows inside the
image; some published systems print MS-SSIM, whose values are often higher. Depth L1: mean error of
the rendered depth, over pixels with measured depth and rendered opacity above 0.5; "of measured" is
the fraction of the measured pixels that are compared. Table cells: mean / median over the frames.
online: the map at the end of the stream, refitted after loop closures. refined: the map after the
further iterations of --refine-iterations.
A: held-out frames, which are tracked and never mapped, without the black rim of rectification. The
rendering gets the vignetting and the rolling shutter that the run has estimated for the camera, and
a gain and bias per channel, interpolated between the keyframes before and after. A, exposure
fitted: gain and bias are fitted to the evaluated frame by least squares. A, no exposure: neither.
B: as in the literature, every fifth frame that is not held out, rendered as in A; pixels without
depth are black in both images.
LOST frames have no pose and are only counted; WEAK frames are evaluated."""


@dataclass(frozen=True, slots=True)
class DepthError:
    """Error of the rendered depth of one image."""

    l1_m: float  # Mean absolute error; NaN if no pixel was compared.
    share: float  # Fraction of the pixels with measured depth that were compared; NaN if none.


def psnr(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the peak signal-to-noise ratio in dB: 10 log10(peak^2 / mean (a - b)^2).

    Args:
        a: Image [H, W, C] or [H, W]; uint8 (peak 255) or floating in 0..1 (peak 1).
        b: Image of the same shape and kind.
        mask: Pixels that are compared, [H, W] bool; None for all.

    Returns:
        The ratio in dB; infinity for equal images, NaN for an empty mask.

    Raises:
        ValueError: If the images differ in shape, or only one of them is uint8.
    """
    if a.shape != b.shape or (a.dtype == np.uint8) != (b.dtype == np.uint8):
        raise ValueError(
            f"PSNR cannot compare images {a.dtype}{a.shape} and {b.dtype}{b.shape}: the shapes "
            "must be equal, and both images must be uint8 or both floating-point."
        )
    peak = 255.0 if a.dtype == np.uint8 else 1.0
    squares = (a.astype(np.float64) - b) ** 2
    squares = squares if mask is None else squares[mask]
    if squares.size == 0:
        return float("nan")
    mse = float(squares.mean())
    return float("inf") if mse == 0 else float(10 * np.log10(peak**2 / mse))


def ssim(a: np.ndarray, b: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Return the mean structural similarity of images [H, W, 3], floating in 0..1.

        (2 m_a m_b + c1) (2 s_ab + c2) / ((m_a^2 + m_b^2 + c1) (s_a^2 + s_b^2 + c2))

    This formula of Wang et al., TIP 2004, uses the means m_a and m_b, the standard deviations s_a
    and s_b, and the covariance s_ab of a channel in an 11x11 Gaussian window of sigma 1.5 px. The
    constants are c1 = 0.01^2 and c2 = 0.03^2. The mean is over channels and over pixels whose
    window lies in the image. Multi-scale SSIM is often higher, and some papers print it as SSIM.

    Args:
        a: Image [H, W, 3].
        b: Image [H, W, 3].
        mask: Pixels that may be in a window, [H, W] bool; None for all.

    Returns:
        The mean, at most 1; NaN if the mask contains no whole window.

    Raises:
        ValueError: If the images differ in shape, or a side is below 11 pixels.
    """
    if a.shape != b.shape or a.ndim != 3 or min(a.shape[:2]) < WINDOW_PX:
        raise ValueError(
            f"SSIM cannot compare images {a.shape} and {b.shape}: the shapes must be equal, and "
            "must be [H, W, C] with H and W at least 11."
        )
    a, b = a.astype(np.float64), b.astype(np.float64)
    mean_a, mean_b = _windowed(a), _windowed(b)
    variances = _windowed(a * a) - mean_a**2 + _windowed(b * b) - mean_b**2
    covariance = _windowed(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + C1) / (mean_a**2 + mean_b**2 + C1)
    values = luminance * (2 * covariance + C2) / (variances + C2)
    if mask is not None:
        margin = WINDOW_PX // 2
        whole = cv2.erode(mask.astype(np.uint8), np.ones((WINDOW_PX, WINDOW_PX), np.uint8))
        values = values[whole[margin:-margin, margin:-margin] > 0]
    return float(np.mean(values)) if values.size else float("nan")


def depth_error(rendered_m: np.ndarray, opacity: np.ndarray, measured_m: np.ndarray) -> DepthError:
    """Compare rendered with measured depth, over pixels that have both.

    Args:
        rendered_m: Rendered depth, [H, W], meters.
        opacity: Rendered opacity, [H, W], 0..1. Pixels with more than 0.5 have a rendered depth.
        measured_m: Measured depth, [H, W], meters; 0 where not measured.
    """
    measured = measured_m > 0
    counted = measured & (opacity > COVERED)
    if not counted.any():
        return DepthError(float("nan"), 0.0 if measured.any() else float("nan"))
    errors_m = np.abs(rendered_m[counted].astype(np.float64) - measured_m[counted])
    return DepthError(float(errors_m.mean()), float(counted.sum() / measured.sum()))


def _windowed(image: np.ndarray) -> np.ndarray:
    """Return the mean under the Gaussian window at each inner pixel, [H - 10, W - 10, C]."""
    kernel = cv2.getGaussianKernel(WINDOW_PX, SIGMA_PX)
    margin = WINDOW_PX // 2
    return cv2.sepFilter2D(image, -1, kernel, kernel)[margin:-margin, margin:-margin]


Images = tuple[np.ndarray, np.ndarray]  # Camera image and rendering, [H, W, 3] in 0..1.
Distance = Callable[[np.ndarray, np.ndarray], float]


@dataclass(frozen=True, eq=False, slots=True)
class RenderedView:
    """A frame with the rendering of the map at the pose of the frame."""

    frame: RgbdFrame
    rendering: Rendering
    # Exposure of the frame, interpolated between keyframes instead of fitted to the frame.
    exposure: Exposure = field(default_factory=Exposure)
    # Pixels that show the camera image, not the rim of rectification, [H, W] bool; None for all.
    valid: np.ndarray | None = None
    # Correction of the camera; `recorded` applies its vignetting.
    correction: CameraCorrection = field(default_factory=CameraCorrection)
    # Motion of the camera during the frame, for the rolling shutter; None if unknown.
    motion: FrameMotion | None = None

    @property
    def seen(self) -> np.ndarray:
        """Camera image, [H, W, 3] float32, 0..1."""
        return self.frame.color.astype(np.float32) / 255

    @property
    def shown(self) -> np.ndarray:
        """Rendering with the exposure of the frame, [H, W, 3] float32, 0..1."""
        return self.recorded(self.exposure.applied(self.rendering.color))

    def recorded(self, color: np.ndarray) -> np.ndarray:
        """Distort a rendered image [H, W, 3] as the camera would record it.

        The image gets the vignetting of the camera, and the distortion that its rolling shutter
        causes in motion.
        """
        camera = self.frame.camera
        if self.motion is not None:
            color = self.motion.recorded(color, self.rendering.depth_m, camera)
        if not self.correction.has_vignetting:
            return color
        return (color / self.correction.gain(camera)).clip(0, 1)

    @property
    def picture(self) -> np.ndarray:
        """Rendering with the exposure of the frame, [H, W, 3] uint8."""
        return np.round(self.shown * 255).astype(np.uint8)

    @property
    def psnr_db(self) -> float:
        """PSNR of the rendering over all valid pixels, dB."""
        return psnr(*every_pixel(self), self.valid)


@dataclass(frozen=True, slots=True)
class ViewErrors:
    """Errors of one rendered frame; the constant `PROTOCOL` of this module defines each metric."""

    frame: int  # Index in the sequence.
    psnr_db: float
    ssim: float
    lpips: float | None  # LPIPS distance; None without a network.
    depth_l1_m: float
    depth_share: float  # Fraction of the pixels with measured depth that were compared.


@dataclass(frozen=True, slots=True)
class RenderingErrors:
    """Errors of one map under one protocol (see the constant `PROTOCOL`), frame by frame."""

    map: str  # Name of the map, such as "online" or "refined".
    protocol: str  # Name of the protocol, a key of HELD_OUT or TRAINING.
    views: tuple[ViewErrors, ...]

    def mean(self, figure: str) -> float | None:
        """Return the mean of a metric over the frames, ignoring NaN; None if all values are NaN.

        Args:
            figure: Metric, the name of a field of ViewErrors.
        """
        values = self._values(figure)
        return float(np.mean(values)) if len(values) else None

    def median(self, figure: str) -> float | None:
        """Return the median of a metric over the frames, ignoring NaN; None if all are NaN."""
        values = self._values(figure)
        return float(np.median(values)) if len(values) else None

    def _values(self, figure: str) -> np.ndarray:
        """Return the values of a metric over the frames, [M], without NaN."""
        values = np.array([getattr(view, figure) for view in self.views], float)
        return values[~np.isnan(values)]


# --- protocols ------------------------------------------------------------------------------------
def every_pixel(view: RenderedView) -> Images:
    """Return camera image and rendering without a mask.

    The rendering has the exposure of the frame, interpolated between the neighboring keyframes.
    """
    return view.seen, view.shown


def exposure_fitted(view: RenderedView) -> Images:
    """Return camera image and rendering; the rendering's exposure is fitted to the camera image."""
    shown, seen = view.recorded(view.rendering.color), view.seen
    fitted = fit_exposure(shown, seen, view.valid)
    return seen, fitted.applied(shown)


def map_as_it_is(view: RenderedView) -> Images:
    """Return camera image and rendering; the rendering keeps the colors of the map."""
    return view.seen, view.recorded(view.rendering.color.clip(0, 1))


def measured_pixels(view: RenderedView) -> Images:
    """Return camera image and rendering, both black where no depth was measured."""
    is_measured = (view.frame.depth_m > 0)[..., None]
    return view.seen * is_measured, view.shown * is_measured


HELD_OUT = {
    "A held out": every_pixel,
    "A held out, exposure fitted": exposure_fitted,
    "A held out, no exposure": map_as_it_is,
}
TRAINING = {"B training": measured_pixels}


@dataclass(frozen=True, slots=True)
class EvaluatedFrames:
    """Held-out frames for protocol A, training frames for protocol B; both include LOST frames."""

    held_out: tuple[RunFrame, ...]
    training: tuple[RunFrame, ...]

    @staticmethod
    def of(frames: Iterable[RunFrame]) -> "EvaluatedFrames":
        """Select all held-out frames and every fifth training frame of a run."""
        frames = tuple(frames)
        training = tuple(frame for frame in frames if not frame.is_held_out)
        return EvaluatedFrames(
            tuple(frame for frame in frames if frame.is_held_out), training[::TRAINING_STEP]
        )

    @property
    def posed(self) -> list[RunFrame]:
        """Frames with a pose."""
        return [frame for frame in (*self.held_out, *self.training) if not frame.is_lost]

    def counts(self) -> str:
        """Return a text that gives the numbers of frames for protocol A and for protocol B."""
        if not self.held_out:
            a = "A: none, because all frames were mapped; use `ldo run --hold-out-every 5`."
        else:
            a = f"A: {_counted(self.held_out)}."
        return f"{a} B: {_counted(self.training)}."


# --- evaluation -----------------------------------------------------------------------------------
def view_of(
    image: RgbdFrame,
    posed: PosedMap,
    frame: RunFrame,
    threads: int = 1,
    valid: np.ndarray | None = None,
) -> RenderedView:
    """Render the map at the pose of a frame.

    Args:
        image: Color and depth of the frame, without correction of vignetting and depth bias.
        posed: The map.
        frame: The frame of the run.
        threads: Threads of the renderer.
        valid: Pixels where the rectified image has content, [H, W] bool; None for all.

    Raises:
        DataError: If the frame has no pose.
    """
    T_camera_map = se3.inverse(posed.T_map_camera(frame))
    rendering = render(posed.rows, image.camera, T_camera_map, threads=threads)
    correction = posed.correction
    depth_m = correction.corrected_depth(image.depth_m, image.camera)
    motion = posed.motion(frame)
    if motion is not None:
        _, depth_m = motion.warped(image.color, depth_m, image.camera)
    exposure = posed.exposures.at(frame.stamp_ns)
    seen = replace(image, depth_m=depth_m)
    return RenderedView(seen, rendering, exposure, valid, correction, motion)


def evaluate_rendering(
    sequence: Sequence,
    judged: EvaluatedFrames,
    maps: Iterable[PosedMap],
    advance: Callable[[int], None],
    *,
    distance: Distance | None = None,
    threads: int = 1,
) -> list[RenderingErrors]:
    """Compute the rendering errors of each map for each protocol in HELD_OUT and TRAINING.

    Args:
        sequence: Source of the frames.
        judged: Frames to evaluate.
        maps: The maps.
        advance: Progress function, called with the number of frames done so far.
        distance: LPIPS of two images [H, W, 3] in 0..1; None to omit LPIPS.
        threads: Threads of the renderer.

    Raises:
        DataError: If a frame cannot be read or has no pose.
    """
    views: dict[tuple[str, str], list[ViewErrors]] = defaultdict(list)
    valid = valid_pixels(sequence.raw_camera)
    for done, frame in enumerate(judged.posed, 1):
        image = sequence[frame.index]
        for posed in maps:
            fits = valid is not None and valid.shape == image.depth_m.shape
            view = view_of(image, posed, frame, threads, valid if fits else None)
            for protocol, errors in evaluate_view(view, frame.is_held_out, distance):
                views[posed.name, protocol].append(errors)
        advance(done)
    order = [(posed.name, protocol) for posed in maps for protocol in (*HELD_OUT, *TRAINING)]
    return [RenderingErrors(*key, tuple(views[key])) for key in order if key in views]


def evaluate_view(
    view: RenderedView, is_held_out: bool, distance: Distance | None = None
) -> Iterator[tuple[str, ViewErrors]]:
    """Yield a pair for each protocol of `PROTOCOL`: its name, and the errors of the frame.

    Args:
        view: The frame with its rendering.
        is_held_out: True for the protocols of held-out frames, False for training frames.
        distance: LPIPS of two images [H, W, 3] in 0..1; None to omit LPIPS.
    """
    rendering = view.rendering
    depth = depth_error(rendering.depth_m, rendering.opacity, view.frame.depth_m)
    for protocol, images in (HELD_OUT if is_held_out else TRAINING).items():
        seen, shown = images(view)
        if view.valid is not None:  # The camera image is black outside of the valid pixels.
            shown = shown * view.valid[..., None]
        yield (
            protocol,
            ViewErrors(
                view.frame.index,
                psnr(seen, shown, view.valid),
                ssim(seen, shown, view.valid),
                distance(seen, shown) if distance else None,
                depth.l1_m,
                depth.share,
            ),
        )


def _counted(frames: tuple[RunFrame, ...]) -> str:
    lost = sum(frame.is_lost for frame in frames)
    weak = sum(frame.status == "WEAK" for frame in frames)
    return f"{len(frames) - lost} of {len(frames)} frames, {lost} LOST, {weak} WEAK"
