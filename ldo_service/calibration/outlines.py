"""Pose between depth and color camera, from outlines of near surfaces and gradients of color.

Depth is registered to color with a pose of the depth camera. That pose may be wrong by a small
increment xi = (r, s), where r is a rotation vector and s is a translation. The true position of a
surface point X of the depth image is then X + cross(r, X) + s in the color camera.

An outline is where depth jumps from a near surface to a far surface. The error xi shifts an outline
away from its edge in the color image. Along the normal n of the outline, the shift in pixels is
n J (xi + v t) + w:

- J [2, 6] is the derivative of the pixel with respect to xi;
- v [6] is the velocity of the camera in its own frame, rad/s and m/s;
- t is the error of `ShutterTiming.depth_delay_s`, seconds;
- w is the width by which the depth camera widens all near surfaces, pixels.

Each point of an outline has a profile: the gradient of color along n, at the pixels around the
point. A Gaussian blurs the profiles. The estimate maximizes the sum of all blurred profiles, each
taken at the shift of its point. The blur becomes narrower from round to round. The search starts at
many rotations, because edges and texture of the near surfaces cause other, lower maxima.

Conventions: `ldo_service.geometry`.
"""

from collections.abc import Generator, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from ldo_service.geometry import Camera

WIDTH = 320  # Approximate width of the images in which outlines are searched, pixels.
REACH_PX = 10  # Maximum shift in these images; 2 degrees for a camera with a usual lens.
MAX_POINTS = 300  # Points of one view.
HOLE_PX = 15  # Window that fills the shadow of a near surface with the depth behind it.
# Ratio of the depths of both sides of an outline. Errors of the depth camera stay below it.
MIN_JUMP_RATIO = 1.12
NEAR_SIDE = 0.97  # A pixel is on the near side if its inverse depth is this close to the nearest.
MIN_CONTRAST = 8.0  # Minimum gradient of color at a point, gray levels per pixel.
BLUR_PX = 1.0  # Standard deviation of the blur of the gray image.
SHARED = slice(0, 6)  # Columns of a point: derivatives n J, row of the image, and the profile.
ROW, PROFILE = 6, slice(7, 7 + 2 * REACH_PX + 1)
COLUMNS = PROFILE.stop
OFFSETS_PX = np.arange(-REACH_PX, REACH_PX + 1)
# Starts of the search: shifts in u and v, pixels, and rotations about the viewing direction, rad.
SEARCH_PX, SEARCH_ROLL = (-6, -3, 0, 3, 6), (-0.017, 0.0, 0.017)
SEARCH_STRIDE, SEARCH_ITERATIONS = 4, 4  # Every fourth point is used.
# Blur of the profiles in the rounds of the search, pixels, and the number of iterations from its
# result.
ROUNDS_PX, ITERATIONS = (2.0, 1.4, 1.0), 6
# Derivatives [N, UNKNOWNS], profiles [N, 2 REACH_PX + 1], and known shifts [N].
_View = tuple[np.ndarray, np.ndarray, np.ndarray]
GROUPS = 8  # Groups of successive views for the jackknife.
MIN_OUTLINES = 300  # Points; fewer yield no estimate.
# Minimum height of a maximum, relative to shifts that are unrelated to the outlines. It is 1.8 on
# freiburg1_rpy, where outlines are blurred, and 3 to 4 on kitchen and on the simulated cameras.
MIN_PEAK_RATIO = 2.5
# A maximum far away is used only if it is this much higher than the one that is reached without a
# rotation. Otherwise, it makes that one uncertain.
MIN_SCORE_RATIO = 1.05
# Fraction of the points that count as independent: an outline has about 20 points.
INDEPENDENT_FRACTION = 0.05
# Prior of increment, width and error of the delay around 0: 1 degree, 2 cm, 2 pixels and 10 ms.
PRIOR_SIGMAS = np.array([0.0175] * 3 + [0.02] * 3 + [2.0, 0.01])
UNKNOWNS = len(PRIOR_SIGMAS)
# Distance at which the shift of depth in the image is stated.
SHIFT_DEPTH_M = 2.0
# Components of the pose as they are reported: rotation in degrees, translation in mm, and the
# shift in the center of the image, mrad. Outlines determine the shift better than its two parts.
COMPONENTS = np.zeros((8, 6))
COMPONENTS[:3, :3], COMPONENTS[3:6, 3:] = np.rad2deg(np.eye(3)), 1e3 * np.eye(3)
COMPONENTS[6, 1], COMPONENTS[6, 3] = 1e3, 1e3 / SHIFT_DEPTH_M
COMPONENTS[7, 0], COMPONENTS[7, 4] = -1e3, 1e3 / SHIFT_DEPTH_M
NAMES = (
    *(f"depth_color_rotation_{axis}_deg" for axis in "xyz"),
    *(f"depth_color_translation_{axis}_mm" for axis in "xyz"),
    *(f"depth_color_shift_{axis}_mrad" for axis in "uv"),
)
SIGMA_NAMES = tuple("_sigma_".join(name.rsplit("_", 1)) for name in NAMES)
# Errors that more views do not reduce, because a depth camera widens near surfaces unevenly and
# shadows one of their sides: 2 mrad and 3 mm, 10 mm along the viewing direction, and 5 mrad with
# 10 mm in both combinations that cancel at SHIFT_DEPTH_M. They are about the errors on the
# simulated Kinects of `room-handheld`.
FLOOR = np.diag(np.square([0.002] * 3 + [0.003, 0.003, 0.01]))
FLOOR[np.ix_((1, 3), (1, 3))] += np.outer([0.005, -0.01], [0.005, -0.01])
FLOOR[np.ix_((0, 4), (0, 4))] += np.outer([0.005, 0.01], [0.005, 0.01])
# Work of an iteration with all points of 30 views, in the unit of `estimation.estimate`.
ITERATION_WORK = 1.2


@dataclass(frozen=True, slots=True)
class Extrinsics:
    """Error of the pose with which depth was registered to color.

    T_color_depth is the pose with which depth was registered. The true pose is
    exp(xi) T_color_depth.
    """

    xi: np.ndarray  # [6] rotation in rad, then translation in m, in the color camera.
    covariance: np.ndarray  # [6, 6] of xi.

    def metrics(self) -> dict[str, float]:
        """Return rotation, translation and image shift, with standard deviations, by metric name.

        Each name ends in the unit of its value. The image shift is the displacement of depth
        against color in the image center, for a surface at the depth SHIFT_DEPTH_M. Its names are
        `depth_color_shift_u_mrad` and `depth_color_shift_v_mrad`.
        """
        sigmas = np.sqrt(np.diag(COMPONENTS @ self.covariance @ COMPONENTS.T)).tolist()
        values = (COMPONENTS @ self.xi).tolist()
        return dict(zip((*NAMES, *SIGMA_NAMES), (*values, *sigmas), strict=True))


def outline_points(color: np.ndarray, depth_m: np.ndarray, camera: Camera) -> np.ndarray:
    """Return points on the outlines of near surfaces, each with its profile.

    A profile has the normalized color gradients at pixels along the normal of the outline.

    Args:
        color: Color image, [H, W, 3] uint8.
        depth_m: Depth registered to the color image, [H, W] meters; 0 where unknown.
        camera: Intrinsics of both images.

    Returns:
        Points, [N, COLUMNS] float32. `SHARED`, `ROW` and `PROFILE` select the columns.
    """
    step = max(1, camera.width // WIDTH)
    height, width = camera.height // step, camera.width // step
    gray = cv2.cvtColor(color[: height * step, : width * step], cv2.COLOR_RGB2GRAY)
    gray = cv2.resize(gray, (width, height), interpolation=cv2.INTER_AREA).astype(np.float32)
    gray = cv2.GaussianBlur(gray, (0, 0), BLUR_PX)
    middle = step // 2
    z = depth_m[middle : height * step : step, middle : width * step : step].astype(np.float32)
    row, column, normal = _outlines(z)
    if not len(row):
        return np.zeros((0, COLUMNS), np.float32)
    # The middle pixel of a block is beside its center if `step` is even.
    shift = (middle - (step - 1) / 2) / step
    u = (column[:, None] + shift + OFFSETS_PX * normal[:, :1]).astype(np.float32)
    v = (row[:, None] + shift + OFFSETS_PX * normal[:, 1:]).astype(np.float32)
    du, dv = (
        cv2.remap(cv2.Sobel(gray, cv2.CV_32F, *axes, scale=0.125), u, v, cv2.INTER_LINEAR)
        for axes in ((1, 0), (0, 1))
    )
    contrast = np.abs(du * normal[:, :1] + dv * normal[:, 1:])
    strongest = contrast.max(axis=1, keepdims=True)
    # A mean gradient is no evidence, and all outlines count alike. The square separates an
    # edge from the texture beside it.
    above = np.maximum(contrast - contrast.mean(axis=1, keepdims=True), 0)
    profile = (above / strongest.clip(1e-6)) ** 2
    pixel = np.stack([column, row], axis=1) * step + middle
    by_pose = _derivatives(pixel, z[row, column], normal, camera) / step
    rows = pixel[:, 1:] / (camera.height - 1) - 0.5
    points = np.concatenate([by_pose, rows, profile], axis=1).astype(np.float32)
    return points[strongest[:, 0] > MIN_CONTRAST]


def _outlines(z: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return row [N], column [N] and normal [N, 2] (u, v) of points on outlines.

    The points are on the near side, and the normals point to the far side.

    Args:
        z: Depth, [h, w] meters; 0 where unknown.
    """
    is_known = z > 0
    filled = np.maximum(z, np.float32(1e-3))
    np.divide(1, filled, out=filled)
    if not is_known.all():
        window = np.ones((HOLE_PX, HOLE_PX), np.uint8)
        farthest = cv2.erode(np.where(is_known, filled, np.float32(1e3)), window)
        filled = np.where(is_known, filled, np.where(farthest < 1e3, farthest, 0))
    near, far = (f(filled, np.ones((3, 3), np.uint8)) for f in (cv2.dilate, cv2.erode))
    # Few pixels are beside a jump, and the other conditions are tested for these alone.
    border, (height, width) = REACH_PX // 2, z.shape
    row, column = np.nonzero(near > MIN_JUMP_RATIO * far)
    is_inside = (row >= border) & (row < height - border)
    is_inside &= (column >= border) & (column < width - border)
    row, column = row[is_inside], column[is_inside]
    at = row, column
    is_outline = is_known[at] & (far[at] > 0) & (filled[at] > NEAR_SIDE * near[at])
    row, column = row[is_outline], column[is_outline]
    stride = -(-len(row) // MAX_POINTS) if len(row) else 1
    row, column = row[::stride], column[::stride]
    smooth = cv2.GaussianBlur(filled, (0, 0), 2.0)
    slope = [cv2.Sobel(smooth, cv2.CV_32F, *axes)[row, column] for axes in ((1, 0), (0, 1))]
    normal = -np.stack(slope, axis=1)
    return row, column, normal / np.linalg.norm(normal, axis=1, keepdims=True).clip(1e-9)


def _derivatives(
    pixel: np.ndarray, z: np.ndarray, normal: np.ndarray, camera: Camera
) -> np.ndarray:
    """Return the derivatives n J [N, 6] of the shift along the normals [N, 2] of pixels [N, 2]."""
    rays = camera.rays_at(pixel[:, 0], pixel[:, 1])
    by_place = np.zeros((len(pixel), 3))
    by_place[:, 0], by_place[:, 1] = normal[:, 0] * camera.fx / z, normal[:, 1] * camera.fy / z
    by_place[:, 2] = -(by_place[:, :2] * rays[:, :2]).sum(axis=1)
    # (rotation x point) . by_place = rotation . (point x by_place)
    return np.concatenate([np.cross(rays * z[:, None], by_place), by_place], axis=1)


def extrinsics(
    points: Sequence[np.ndarray], velocities: Sequence[np.ndarray], times_s: np.ndarray
) -> Generator[float, None, Extrinsics | None]:
    """Estimate the error of the pose between depth and color camera.

    The generator yields the amount of work after each step, as `estimation.estimate` does.

    Args:
        points: Outline points of each view, in order of time; see `outline_points`.
        velocities: Velocity of the camera in each view, [6] rad/s and m/s, in the camera frame.
        times_s: Shutter times, [3] seconds, in the order of `ShutterTiming`. The camera's motion
            during these times shifts the outlines too.

    Returns:
        The estimate; None if there are too few points, or if the search finds no clear maximum.
    """
    if sum(map(len, points)) < MIN_OUTLINES:
        return None
    readout_s, depth_readout_s, delay_s = times_s
    views: list[_View] = []
    for each, velocity in zip(points, velocities, strict=True):
        by_time = each[:, SHARED] @ velocity
        time_s = delay_s + (depth_readout_s - readout_s) * each[:, ROW]
        J = np.c_[each[:, SHARED], np.ones(len(each)), by_time].astype(float)
        views.append((J, each[:, PROFILE], by_time * time_s))
    starts = yield from _searched(views)
    (near, _), (best, information) = (
        _climbed(views, start, ROUNDS_PX[-1], ITERATIONS) for start in starts
    )
    yield 2 * ITERATIONS * ITERATION_WORK
    everything = _joined(views)
    scores = [float(_weights(everything, each, ROUNDS_PX[-1])[0].sum()) for each in (near, best)]
    kernel = np.exp(-0.5 * (OFFSETS_PX / ROUNDS_PX[-1]) ** 2).sum()
    if scores[1] < MIN_PEAK_RATIO * kernel * everything[1].mean(axis=1).sum():
        return None
    is_ambiguous = scores[1] < MIN_SCORE_RATIO * scores[0]
    found, other = (near, best - near) if is_ambiguous else (best, np.zeros(UNKNOWNS))
    parts = []
    for group in np.array_split(np.arange(len(views)), min(GROUPS, len(views))):
        others = [view for i, view in enumerate(views) if i not in group]
        parts.append(_climbed(others, found, ROUNDS_PX[-1], ITERATIONS)[0])
        yield ITERATIONS * ITERATION_WORK
    jackknife = (len(parts) - 1) * np.cov(np.array(parts).T, bias=True)
    covariance = jackknife + np.linalg.inv(information) + np.outer(other, other)
    return Extrinsics(found[SHARED], covariance[SHARED, SHARED] + FLOOR)


def _joined(views: Sequence[_View]) -> _View:
    J, profile, known = (np.concatenate(parts) for parts in zip(*views, strict=True))
    return J, profile, known


def _searched(
    views: Sequence[_View],
) -> Generator[float, None, tuple[np.ndarray, np.ndarray]]:
    """Return the unknowns [UNKNOWNS] at two maxima.

    The first one is reached without a rotation. The second one is the highest of the maxima that
    many rotations lead to. Edges and texture of near surfaces make other maxima, which are lower.
    """
    J, profile, known = (part[::SEARCH_STRIDE] for part in _joined(views))
    few: _View = (J, profile, known)
    # Rotation by which the shifts change by about a pixel.
    step = 1 / float(np.sqrt((J[:, :2] ** 2).sum(axis=1)).mean())
    best, near = -np.inf, np.zeros(UNKNOWNS)
    found = near
    for i, j, roll in product(SEARCH_PX, SEARCH_PX, SEARCH_ROLL):
        now = np.array([i * step, j * step, roll, 0.0, 0.0, 0.0, 0.5, 0.0])
        for sigma_px in ROUNDS_PX:
            now, _ = _climbed([few], now, sigma_px, SEARCH_ITERATIONS)
        weight, _ = _weights(few, now, ROUNDS_PX[-1])
        if not (i or j or roll):
            near = now
        if weight.sum() > best:
            best, found = float(weight.sum()), now
        yield len(ROUNDS_PX) * SEARCH_ITERATIONS * ITERATION_WORK / SEARCH_STRIDE
    return near, found


def _weights(view: _View, now: np.ndarray, sigma_px: float) -> tuple[np.ndarray, np.ndarray]:
    """Return the blurred profiles [N, 2 REACH_PX + 1] around the shifts [N], and the shifts."""
    J, profile, known = view
    shift = J @ now + known
    return profile * np.exp(-0.5 * ((OFFSETS_PX - shift[:, None]) / sigma_px) ** 2), shift


def _climbed(
    views: Sequence[_View], start: np.ndarray, sigma_px: float, iterations: int
) -> tuple[np.ndarray, np.ndarray]:
    """Maximize the sum of the blurred profiles by expectation maximization.

    Args:
        views: Points of all views.
        start: Unknowns to start at: increment, width and error of the delay, [UNKNOWNS].
        sigma_px: Standard deviation of the blur.
        iterations: Number of iterations.

    Returns:
        The unknowns [UNKNOWNS] and their information matrix.
    """
    J, profile, known = _joined(views)
    prior = np.diag(PRIOR_SIGMAS**-2.0)
    now, information = start, prior
    for _ in range(iterations):
        weight, shift = _weights((J, profile, known), now, sigma_px)
        total = weight.sum(axis=1)
        residual = weight @ OFFSETS_PX - total * shift
        scale = INDEPENDENT_FRACTION / sigma_px**2
        information = scale * (J * total[:, None]).T @ J + prior
        now = now + np.linalg.solve(information, scale * J.T @ residual - prior @ now)
    return now, information
