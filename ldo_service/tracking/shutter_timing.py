"""Estimation of the times at which a camera records the rows of color and depth.

A rolling shutter and a delay between color and depth displace the parts of a frame in proportion to
the velocity of the camera. The displacement of a row is a twist: the velocity times the time at
which the row was recorded. This time depends on three constants of the camera: the readout time of
color, the readout time of depth, and the delay of depth. These three times become additional
unknowns of the normal equations of alignment, and are the same for all frames.

`BandEquations` holds the normal equations of one frame, one set for each band of rows.
`BandEquations.timing_equations` eliminates pose and exposure, so that only the three times remain
unknown. `TimingEvidence` adds up these equations over many frames. The velocity changes its
direction over time, so the static errors of a camera, such as a depth bias, average out.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import Any

import numpy as np

from ldo_service.calibration.shutter import FrameMotion
from ldo_service.geometry import se3

from .alignment import NO_WEIGHT, BrightnessModel, ResidualConfig, normal_equations
from .pose_covariance import BRIGHTNESS_PRIOR, POSE
from .pyramid import Level, Pyramid, ReferencePoints

OWN = slice(0, 8)  # Unknowns of a frame: pose increment [6], gain, bias.
SHARED = slice(8, 11)  # Unknowns of the camera: readout of color, readout and delay of depth.
# Pyramid level of the equations: 160 pixels wide. Displacements of several pixels at 640 are small
# enough there for a linear model.
LEVEL = 1
BANDS = 6  # Bands of rows that are displaced as a whole.
MIN_BAND_POINTS = 50  # Points; a band with fewer is left out.
ROW_STRIDE = 4  # The mean row of a band is computed from every fourth point.
# Noise of the equations as a multiple of the noise of alignment. The rows far from the middle
# determine the readout. They are outliers of the alignment until the readout is compensated.
NOISE_RATIO = 3.0
# Fraction of the residuals that counts as independent, because the errors of neighboring residuals
# are correlated. The measured pose errors correspond to a fraction of 0.1 on exact renders, and of
# 1e-4 to 3e-5 on a Kinect. The value lies between them.
INDEPENDENT_FRACTION = 2e-3
# Equations of a prior: readouts of 0 to 20 ms and delays of 0 to 10 ms are usual.
PRIOR = np.c_[np.diag([0.02**-2, 0.02**-2, 0.01**-2]), np.zeros(3)]
MIN_GROUPS, MAX_GROUPS = 12, 24  # Groups of the jackknife; two are merged beyond the maximum.


@dataclass(frozen=True, eq=False, slots=True)
class BandEquations:
    """Normal equations of a frame at its pose, for each of B bands of rows.

    The unknowns are those of `NormalEquations`: pose increment, gain and bias. As in `FrameMotion`,
    each velocity [6] has the rotation in rad/s first, then the translation in m/s.
    """

    hessian: np.ndarray  # [B, 2, 8, 8]: color, then depth.
    gradient: np.ndarray  # [B, 2, 8]
    # Mean row of each band in the reference and in the frame, [B, 2], from -0.5 (top) to 0.5.
    rows: np.ndarray
    T_camera_reference: np.ndarray  # [4, 4]
    at_reference: FrameMotion  # Motion that is compensated in the reference.
    at_frame: FrameMotion  # Motion that is compensated in the frame.
    reference_velocity: np.ndarray  # [6] best estimate of the velocity at the reference.

    def pack(self) -> dict[str, Any]:
        """Return the equations as arrays and plain values."""
        return {
            "hessian": self.hessian,
            "gradient": self.gradient,
            "rows": self.rows,
            "T_camera_reference": self.T_camera_reference,
            "at_reference": self.at_reference.pack(),
            "at_frame": self.at_frame.pack(),
            "reference_velocity": self.reference_velocity,
        }

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "BandEquations":
        """Return the equations from their packed form."""
        motions = {name: FrameMotion.unpack(kept[name]) for name in ("at_reference", "at_frame")}
        return BandEquations(**{**kept, **motions})

    def pose_change(self, velocity: np.ndarray) -> np.ndarray:
        """Return the change of the pose if the shutter is compensated with another velocity.

        The change is a first-order approximation.

        Args:
            velocity: Velocity that replaces `at_frame.velocity`, [6].

        Returns:
            The increment xi [6], which changes the pose to T_reference_camera * exp(xi).
        """
        difference = replace(self.at_frame, velocity=velocity - self.at_frame.velocity)
        twists = _row_twists(difference, self.rows[:, 1])
        A = self.hessian.sum(axis=(0, 1)) + np.diag(np.r_[np.full(6, 1e-6), BRIGHTNESS_PRIOR])
        b = (self.hessian[..., POSE] @ twists[..., None]).sum(axis=(0, 1, 3))
        return -np.linalg.solve(A, b)[POSE]

    def timing_equations(self, velocity: np.ndarray) -> np.ndarray:
        """Return the normal equations for the times of the shutter.

        Args:
            velocity: Best estimate of the velocity at the frame, [6].

        Returns:
            Information matrix and right side, [3, 4], of the three times in seconds. The order of
            the times is that of `ShutterTiming`. The solution contains the total times, even if
            earlier estimates of the times are already compensated in the frame.
        """
        # Velocities of the reference in the camera frame. All twists change T_reference_camera.
        to_camera = se3.adjoint(self.T_camera_reference)
        velocity_there = to_camera @ self.reference_velocity
        used_there = replace(self.at_reference, velocity=to_camera @ self.at_reference.velocity)
        there, here = self.rows.T
        # Twists [B, 2, 6] that are compensated already, and twists per second of each time.
        done = _row_twists(self.at_frame, here) - _row_twists(used_there, there)
        J = np.zeros((len(here), 2, 11, 8))
        J[:, :, OWN] = np.eye(8)
        by_readout = here[:, None] * velocity - there[:, None] * velocity_there
        J[:, 0, 8, POSE] = J[:, 1, 9, POSE] = by_readout
        J[:, 1, 10, POSE] = velocity - velocity_there
        weighted = J @ self.hessian
        A = (weighted @ J.swapaxes(-1, -2)).sum(axis=(0, 1))
        b = (weighted[..., POSE] @ done[..., None])[..., 0] - (J @ self.gradient[..., None])[..., 0]
        b = b.sum(axis=(0, 1))
        A[OWN, OWN] += np.diag(np.r_[np.full(6, 1e-6), BRIGHTNESS_PRIOR])
        eliminated = np.linalg.solve(A[OWN, OWN], np.c_[A[OWN, SHARED], b[OWN]])
        return np.c_[A[SHARED, SHARED], b[SHARED]] - A[SHARED, OWN] @ eliminated


def band_equations(
    reference: ReferencePoints,
    frame: Pyramid,
    T_camera_reference: np.ndarray,
    brightness: BrightnessModel,
    config: ResidualConfig,
    at_reference: FrameMotion,
    at_frame: FrameMotion,
    reference_velocity: np.ndarray,
) -> BandEquations:
    """Linearize the residuals of a frame at its pose, separately for each band of rows.

    Args:
        reference: Surface points of the reference keyframe.
        frame: Pyramid of the frame.
        T_camera_reference: Pose by alignment, [4, 4].
        brightness: Exposure and noise by alignment.
        config: Settings of the residuals.
        at_reference: Motion that is compensated in the reference.
        at_frame: Motion that is compensated in the frame.
        reference_velocity: Best estimate of the velocity at the reference, [6].
    """
    index = min(LEVEL, len(frame.levels) - 1, len(reference.points) - 1)
    points, level = reference.points[index], frame.levels[index]
    color = replace(
        brightness,
        intensity_sigma=NOISE_RATIO * brightness.intensity_sigma,
        depth_noise_scale=NO_WEIGHT,
    )
    depth = replace(
        brightness,
        intensity_sigma=NO_WEIGHT,
        depth_noise_scale=NOISE_RATIO * brightness.depth_noise_scale,
    )
    hessians, gradients, rows = [], [], []
    bands = _bands(points, level)
    sampled = [np.arange(first, last, ROW_STRIDE) for first, last in bands]
    every_row = _rows(points[:, np.concatenate(sampled)], level, T_camera_reference)
    end = 0
    for (first, last), places in zip(bands, sampled, strict=True):
        start, end = end, end + len(places)
        row_there, row_here, inside = (values[start:end] for values in every_row)
        if ROW_STRIDE * np.count_nonzero(inside) < MIN_BAND_POINTS:
            continue
        band = np.ascontiguousarray(points[:, first:last])
        equations = [
            normal_equations(band, level, T_camera_reference, noise, config)
            for noise in (color, depth)
        ]
        hessians.append([e.hessian for e in equations])
        gradients.append([e.gradient for e in equations])
        rows.append((row_there[inside].mean(), row_here[inside].mean()))
    return BandEquations(
        np.array(hessians).reshape(-1, 2, 8, 8),
        np.array(gradients).reshape(-1, 2, 8),
        np.array(rows, float).reshape(-1, 2),
        T_camera_reference,
        at_reference,
        at_frame,
        reference_velocity,
    )


@dataclass(frozen=True, eq=False, slots=True)
class TimingEvidence:
    """Timing equations of many frames, summed over groups of successive frames."""

    groups: tuple[np.ndarray, ...] = ()  # [3, 4] each: information | right side, in order of time.
    size: int = 1  # Frames per complete group.
    in_last: int = 0  # Frames in the last group.
    count: int = 0  # Frames in all groups.
    # Prior of the times as information and right side, [3, 4]: the estimate of the
    # self-calibration, or `PRIOR` before it: usual times.
    prior: np.ndarray = field(default_factory=PRIOR.copy)

    def extended(self, measurement: np.ndarray) -> "TimingEvidence":
        """Return the evidence with the timing equations [3, 4] of one more frame."""
        groups, size, in_last = list(self.groups), self.size, self.in_last
        if groups and in_last < size:
            groups[-1] = groups[-1] + measurement
        else:
            groups, in_last = [*groups, measurement], 0
            if len(groups) > MAX_GROUPS:
                last = groups.pop()
                groups = [a + b for a, b in zip(groups[::2], groups[1::2], strict=True)]
                groups, size = [*groups, last], 2 * size
        return TimingEvidence(tuple(groups), size, in_last + 1, self.count + 1, self.prior)

    def estimate(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Return the times [3] of the shutter in seconds, and their standard deviations [3].

        The times are the readout times of color and depth, and the delay of depth.

        If the frames do not determine a time, the prior determines it. Each variance is the sum of
        two estimates. The first is a jackknife over the groups of successive frames, because
        neighboring frames have similar errors. The second is the inverse of the information,
        because a jackknife over few groups may be small by chance.

        If there are fewer than `MIN_GROUPS` groups, the result is the prior, or None if the
        self-calibration has not yet replaced the initial prior.
        """
        if len(self.groups) < MIN_GROUPS:
            if np.array_equal(self.prior, PRIOR):
                return None
            covariance = np.linalg.inv(self.prior[:, :3])
            return covariance @ self.prior[:, 3], np.sqrt(np.diag(covariance))
        groups = np.array(self.groups) * (INDEPENDENT_FRACTION * NOISE_RATIO**2)
        total = groups.sum(axis=0)
        parts = self._solved(total - groups)
        jackknife = (len(parts) - 1) * np.var(parts, axis=0)
        by_information = np.diag(np.linalg.inv(total[:, :3] + self.prior[:, :3]))
        return self._solved(total), np.sqrt(jackknife + by_information)

    def _solved(self, equations: np.ndarray) -> np.ndarray:
        total = equations + self.prior
        return np.linalg.solve(total[..., :3], total[..., 3:])[..., 0]

    def scaled(self, weight: float) -> "TimingEvidence":
        """Return the evidence with the equations of all frames multiplied by a weight."""
        return replace(self, groups=tuple(weight * group for group in self.groups))

    def pack(self) -> dict[str, Any]:
        """Return the evidence as arrays and plain values."""
        return {
            "groups": list(self.groups),
            "size": self.size,
            "in_last": self.in_last,
            "count": self.count,
            "prior": self.prior,
        }

    @staticmethod
    def unpack(kept: Mapping[str, Any]) -> "TimingEvidence":
        """Return the evidence from its packed form."""
        return TimingEvidence(
            tuple(kept["groups"]),
            int(kept["size"]),
            int(kept["in_last"]),
            int(kept["count"]),
            kept.get("prior", PRIOR),  # A state of an earlier version has no prior.
        )


def _row_twists(motion: FrameMotion, rows: np.ndarray) -> np.ndarray:
    """Return the twists [B, 2, 6] by which the motion moved rows [B] of color and of depth.

    Rows are numbered from -0.5 to 0.5.
    """
    timing = motion.timing
    color_s = timing.readout_s * rows
    depth_s = timing.depth_readout_s * rows + timing.depth_delay_s
    return np.stack([color_s, depth_s], axis=1)[..., None] * motion.velocity


def _bands(points: np.ndarray, level: Level) -> list[tuple[int, int]]:
    """Return the first and last index of the points [7, N] of each band; points ascend by row."""
    camera = level.camera
    row = np.rint(points[1] / points[2] * np.float32(camera.fy) + np.float32(camera.cy))
    edges = np.linspace(-0.5, camera.height - 0.5, BANDS + 1)
    return list(pairwise(np.searchsorted(row, edges).tolist()))


def _rows(
    points: np.ndarray, level: Level, T_camera_reference: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return where points [7, N] of the reference are in the images.

    Returns:
        Their rows [N] in the reference and in the frame, -0.5..0.5, and whether they are in a row
        of the frame, [N] bool.
    """
    camera = level.camera
    R, t = T_camera_reference[:3, :3], T_camera_reference[:3, 3]
    moved = R[1:] @ points[:3] + t[1:, None]
    depth_m = np.maximum(moved[1], 1e-3)
    middle, height = (camera.height - 1) / 2, camera.height
    row_there = (points[1] / points[2] * camera.fy + camera.cy - middle) / height
    row_here = (moved[0] / depth_m * camera.fy + camera.cy - middle) / height
    return row_there, row_here, np.abs(row_here) <= 0.5
