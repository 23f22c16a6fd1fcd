"""Pose estimation between two keyframes: RANSAC over correspondences, and consistency of depth.

Conventions: `ldo_service.geometry`.
"""

from dataclasses import dataclass

import numpy as np

from ldo_service.errors import ConfigError, named
from ldo_service.geometry import Camera, se3
from ldo_service.geometry.se3 import fit_rigid_transform

# Minimum height in meters of a triangle of points, above its longest side. Three points that are
# nearly on a line do not determine the rotation about this line.
SPREAD = 0.1


@dataclass(frozen=True, eq=False, slots=True)
class RansacResult:
    """Rigid transform that RANSAC estimated, and its inliers.

    Attributes:
        T_a_b: Estimated transform from frame b to frame a, [4, 4].
        inliers: True for correspondences that agree with the transform, [M] bool.
    """

    T_a_b: np.ndarray
    inliers: np.ndarray


def ransac_rigid(
    p_a: np.ndarray,
    p_b: np.ndarray,
    pairs: np.ndarray,
    limit_m: float,
    iterations: int,
    rng: np.random.Generator,
) -> RansacResult | None:
    """Return the rigid transform that most correspondences agree with, by RANSAC over triples.

    The transform of the best triple is fitted again to all its inliers.

    Args:
        p_a: Points in frame a, [K, 3], meters.
        p_b: Points in frame b, [L, 3], meters.
        pairs: Indices (a, b) of possible correspondences, [M, 2]. A point may be in several pairs,
            but only in one inlier; pairs with smaller distances take precedence.
        limit_m: Maximum distance of an inlier, meters.
        iterations: Number of triples to try.
        rng: Source of random triples.

    Returns:
        The result. None if no triple of pairs forms the same triangle in both sets. Also None if
        the best such triple has fewer than three inliers.
    """
    best: RansacResult | None = None
    if len(pairs) < 3:
        return None
    for _ in range(iterations):
        a, b = pairs[rng.choice(len(pairs), 3, replace=False)].T
        if len({*a}) < 3 or len({*b}) < 3 or not _are_congruent(p_a[a], p_b[b], limit_m):
            continue
        motion = _supported(p_a, p_b, pairs, fit_rigid_transform(p_b[b], p_a[a]), limit_m)
        if best is None or motion.inliers.sum() > best.inliers.sum():
            best = motion
    if best is None or best.inliers.sum() < 3:
        return None
    a, b = pairs[best.inliers].T
    return _supported(p_a, p_b, pairs, fit_rigid_transform(p_b[b], p_a[a]), limit_m)


def _are_congruent(p_a: np.ndarray, p_b: np.ndarray, limit_m: float) -> bool:
    """Return whether two triangles [3, 3] are congruent and determine a transform.

    Their sides must be equal within 2 `limit_m`, and the first triangle must be at least `SPREAD`
    high.
    """
    sides_a, sides_b = (np.linalg.norm(p - np.roll(p, 1, axis=0), axis=1) for p in (p_a, p_b))
    if np.abs(sides_a - sides_b).max() > 2 * limit_m:
        return False
    area = np.linalg.norm(np.cross(p_a[1] - p_a[0], p_a[2] - p_a[0]))
    return bool(area > SPREAD * sides_a.max())


def _supported(
    p_a: np.ndarray, p_b: np.ndarray, pairs: np.ndarray, T_a_b: np.ndarray, limit_m: float
) -> RansacResult:
    """Return a transform with its inliers; each point is in at most one inlier pair."""
    gaps_m = np.linalg.norm(p_a[pairs[:, 0]] - se3.transform(T_a_b, p_b[pairs[:, 1]]), axis=1)
    inliers = np.zeros(len(pairs), bool)
    used: tuple[set[int], set[int]] = set(), set()
    for m in np.argsort(gaps_m, kind="stable"):
        a, b = map(int, pairs[m])
        if gaps_m[m] <= limit_m and a not in used[0] and b not in used[1]:
            inliers[m] = True
            used[0].add(a)
            used[1].add(b)
    return RansacResult(T_a_b, inliers)


@dataclass(frozen=True, slots=True)
class DepthConsistencyConfig:
    """Limits for the depth consistency of two keyframes."""

    # Maximum distance along the ray between two depths of the same surface.
    gate_m: float = 0.1
    # Fraction of the depth that is added to gate_m. It allows for the noise of structured light at
    # a depth of 5 m.
    gate_share: float = 0.02
    # Minimum fraction of the new surface that the old keyframe also sees.
    min_overlap: float = 0.2
    # Maximum root mean square distance of the two surfaces along the normals.
    max_rmse_m: float = 0.03
    # Maximum conflict: the fraction of the new points in the old view that lie in free space, in
    # front of the surface that the old camera measured. Moved objects cause some conflict; a wrong
    # pose puts walls into free space.
    max_conflict: float = 0.15

    def __post_init__(self) -> None:
        if min(self.gate_m, self.max_rmse_m) <= 0 or self.gate_share < 0:
            raise ConfigError(
                named(self, "gate_m", "gate_share", "max_rmse_m")
                + ": gate_m and max_rmse_m must be positive, and gate_share at least 0."
            )
        if not (0 <= self.min_overlap <= 1 and 0 <= self.max_conflict <= 1):
            raise ConfigError(
                named(self, "min_overlap", "max_conflict") + ": both must be within 0..1."
            )


@dataclass(frozen=True, slots=True)
class DepthConsistency:
    """Comparison of a new surface with the depth of an old keyframe."""

    overlap: float  # Fraction of the new surface's points that the old keyframe also measured.
    rmse_m: float  # Root mean square distance of these points along their normals.
    # Fraction of the new points in the old view that lie in free space, in front of the
    # surface that the old camera measured.
    conflict: float


def check_depth_consistency(
    points: np.ndarray,
    T_old_new: np.ndarray,
    old_depth_m: np.ndarray,
    camera: Camera,
    config: DepthConsistencyConfig,
) -> DepthConsistency:
    """Compare the surface of a new keyframe with the depth of an old one.

    A point p with normal n projects to a pixel whose depth gives the point q on the same ray:

        |z_p - z_q| <= gate    same surface, residual n . (p - q)
        z_p < z_q - gate       in the free space of the old camera: conflict
        z_p > z_q + gate       occluded, no information

    Here gate = gate_m + gate_share z_q.

    Args:
        points: Points of the new keyframe, [7, N]; `tracking.pyramid.ReferencePoints` describes the
            rows.
        T_old_new: Pose of the new keyframe in the old one, [4, 4].
        old_depth_m: Depth of the old keyframe, [H, W], meters; 0 where unknown.
        camera: Intrinsics of the old keyframe.
        config: Limits; only `gate_m` and `gate_share` are used.

    Returns:
        The comparison; all values are 0 if no point projects to a pixel with depth.
    """
    p = se3.transform(T_old_new, points[:3].T.astype(float))
    normals = points[4:7].T.astype(float) @ T_old_new[:3, :3].T
    seen = np.flatnonzero(p[:, 2] > 0)
    pixels = np.rint(camera.project(p[seen])).astype(np.int64)
    inside = np.all((pixels >= 0) & (pixels < [camera.width, camera.height]), axis=1)
    seen, (u, v) = seen[inside], pixels[inside].T
    old_m = old_depth_m[v, u].astype(float)
    seen, old_m = seen[old_m > 0], old_m[old_m > 0]
    if not len(seen):
        return DepthConsistency(0.0, 0.0, 0.0)
    z = p[seen, 2]
    gate_m = config.gate_m + config.gate_share * old_m
    is_one = np.abs(z - old_m) <= gate_m
    along = np.einsum("ij,ij->i", normals[seen], p[seen] * (1 - old_m / z)[:, None])
    has_normal = is_one & np.any(normals[seen] != 0, axis=1)
    squares = along[has_normal] ** 2
    return DepthConsistency(
        overlap=float(is_one.sum() / points.shape[1]),
        rmse_m=float(np.sqrt(squares.mean())) if len(squares) else 0.0,
        conflict=float((z < old_m - gate_m).mean()),
    )
