"""Rigid transforms as 4x4 float64 arrays. Conventions: `ldo_service.geometry`.

The module contains the exponential and the logarithm of SE(3) and conversions of rotations. It also
interpolates between pairs of transforms, and fits a transform to corresponding points (Umeyama,
PAMI 1991).
"""

from math import atan2, copysign, cos, sin, sqrt

import numpy as np
from scipy.linalg import get_lapack_funcs
from scipy.spatial.transform import Rotation

Array = np.ndarray
IDENTITY = np.eye(4)  # It is never changed.
IDENTITY.setflags(write=False)
IDENTITY_3 = IDENTITY[:3, :3]
# Singular value decomposition.
(GESDD,) = get_lapack_funcs(("gesdd",), dtype=np.float64)
MAX_ROUNDING = 1e-12  # Largest error of R R^T of a rotation R; a larger one is removed first.


def length(v: Array) -> float:
    """Return the length of a vector [N]; `np.linalg.norm` takes longer for its checks."""
    return sqrt(v.dot(v))


def skew(v: Array) -> Array:
    """Return the matrix [3, 3] of the cross product: `skew(v) @ w == cross(v, w)`."""
    x, y, z = v.tolist() if isinstance(v, np.ndarray) else v
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def exp(xi: Array) -> Array:
    """Return the transform [4, 4] of a tangent vector xi [6] (rotation rad, translation m)."""
    omega, v = np.asarray(xi[:3], float), np.asarray(xi[3:], float)
    theta = length(omega)
    W = skew(omega)
    if theta < 1e-6:  # Second-order series with an error below 1e-18.
        a, b, c = 1.0 - theta**2 / 6, 0.5 - theta**2 / 24, 1.0 / 6 - theta**2 / 120
    else:
        a = sin(theta) / theta
        b = 2.0 * (sin(theta / 2) / theta) ** 2  # 1 - cos would lose digits near zero.
        c = (1.0 - a) / theta**2
    bW = b * W
    T = IDENTITY.copy()
    T[:3, :3] += a * W + bW @ W
    T[:3, 3] = (IDENTITY_3 + bW + c * W @ W) @ v
    return T


def log(T: Array) -> Array:
    """Return the tangent vector [6] of T [4, 4]; the inverse of `exp` for rotations below pi."""
    omega = rotation_vector(T[:3, :3])
    theta = length(omega)
    W = skew(omega)
    if theta < 1e-4:  # The closed form loses digits here; the series is exact to 1e-17.
        d = 1.0 / 12 + theta**2 / 720
    else:
        d = (1.0 - theta * cos(theta / 2) / (2 * sin(theta / 2))) / theta**2
    out = np.empty(6)
    out[:3], out[3:] = omega, (IDENTITY_3 - 0.5 * W + d * W @ W) @ T[:3, 3]
    return out


def rotation_vector(R: Array) -> Array:
    """Return the rotation vector [3] in rad of a rotation [3, 3].

    The formulas are those of `scipy.spatial.transform.Rotation`, whose checks of one matrix take
    ten times as long as the conversion.

    Raises:
        ValueError: The matrix is not a rotation: its determinant is not positive.
    """
    x, y, z, w = _unit_quaternion(R)
    sine = sqrt(x * x + y * y + z * z)
    angle = 2.0 * atan2(sine, w)
    if angle <= 1e-3:  # A series, since the sine may be 0.
        scale = 2.0 + angle**2 / 12 + 7.0 * angle**4 / 2880
    else:
        scale = angle / sin(angle / 2)
    return np.array([scale * x, scale * y, scale * z])


def _unit_quaternion(R: Array) -> tuple[float, float, float, float]:
    """Return the unit quaternion xyzw, w >= 0, of a rotation [3, 3].

    Raises:
        ValueError: The determinant is not positive.
    """
    m = R.tolist()
    (a, b, c), (d, e, f), (g, h, i) = m
    trace, largest = a + e + i, max(a, e, i)
    if trace >= largest:
        x, y, z, w = h - f, c - g, d - b, 1.0 + trace
    else:
        n = [a, e, i].index(largest)
        j, k = (n + 1) % 3, (n + 2) % 3
        q = [0.0, 0.0, 0.0]
        q[n], q[j], q[k] = 1.0 - trace + 2.0 * largest, m[j][n] + m[n][j], m[k][n] + m[n][k]
        (x, y, z), w = q, m[k][j] - m[j][k]
    is_right_handed = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.5
    is_exact = is_right_handed and abs(R @ R.T - IDENTITY_3).max() < MAX_ROUNDING
    if not is_exact or w == 0.0:  # Two quaternions with w = 0 are of one rotation.
        x, y, z, w = Rotation.from_matrix(R).as_quat(canonical=True).tolist()
        return x, y, z, w
    norm = copysign(sqrt(x * x + y * y + z * z + w * w), w)
    return x / norm, y / norm, z / norm, w / norm


def inverse(T: Array) -> Array:
    """Return the inverse [..., 4, 4] of transforms; T must contain proper rotations."""
    out = np.zeros_like(T, dtype=float)
    R_t = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = R_t
    out[..., :3, 3] = -(R_t @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def orthonormalize(T: Array) -> Array:
    """Return a copy of T [4, 4] whose upper left 3x3 block is replaced by the nearest rotation.

    This removes the rounding errors that products of transforms accumulate.

    Raises:
        LinAlgError: The block contains NaN or infinity.
    """
    U, _, Vt, info = GESDD(T[:3, :3])  # `np.linalg.svd` takes three times as long.
    if info:
        raise np.linalg.LinAlgError("The SVD of a transform did not converge.")
    U[:, 2] *= np.linalg.det(U @ Vt)
    out = IDENTITY.copy()
    out[:3, :3] = U @ Vt
    out[:3, 3] = T[:3, 3]
    return out


def adjoint(T: Array) -> Array:
    """Return the adjoint Adj [6, 6] with `T * exp(xi) == exp(Adj @ xi) * T`."""
    R, t = T[:3, :3], T[:3, 3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = R
    out[3:, :3] = skew(t) @ R
    return out


def rotation_angle(T: Array) -> float:
    """Return the rotation angle of T [4, 4] in radians, 0..pi."""
    (a, b, c), (d, e, f), (g, h, i) = T[:3, :3].tolist()
    x, y, z = h - f, c - g, d - b
    return float(np.arctan2(sqrt(x * x + y * y + z * z), a + e + i - 1.0))


def distance(T: Array) -> float:
    """Return the length of the translation of T [4, 4], in meters."""
    x, y, z = T[:3, 3].tolist()
    return sqrt(x * x + y * y + z * z)


def rotation_angles(T: Array) -> Array:
    """Return the rotation angles [...] of T [..., 4, 4] in radians, 0..pi."""
    R = T[..., :3, :3]
    pairs = ((2, 1), (0, 2), (1, 0))
    twice_sin = np.stack([R[..., i, j] - R[..., j, i] for i, j in pairs], axis=-1)
    twice_cos = np.trace(R, axis1=-2, axis2=-1) - 1.0
    return np.arctan2(np.linalg.norm(twice_sin, axis=-1), twice_cos)


def distances(T: Array) -> Array:
    """Return the lengths [...] of the translations of T [..., 4, 4], in meters."""
    return np.linalg.norm(T[..., :3, 3], axis=-1)


def transform(T: Array, points: Array) -> Array:
    """Transform points [..., 3] from frame b to frame a by T = T_a_b [4, 4]."""
    return points @ T[:3, :3].T + T[:3, 3]


def quaternion(R: Array) -> Array:
    """Return the unit quaternions wxyz [..., 4], w >= 0, of rotations R [..., 3, 3].

    Raises:
        ValueError: A matrix is not a rotation: its determinant is not positive.
    """
    if R.shape == (3, 3):
        x, y, z, w = _unit_quaternion(R)
        return np.array([w, x, y, z])
    if not R.size:  # Some supported versions of SciPy reject an empty batch.
        return np.zeros((*R.shape[:-2], 4))
    xyzw = Rotation.from_matrix(R.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.roll(xyzw, 1, axis=-1).reshape(*R.shape[:-2], 4)


def rotation(q: Array) -> Array:
    """Return the rotations [..., 3, 3] of quaternions wxyz [..., 4], normalized or not."""
    q = np.asarray(q)
    unit = q / np.linalg.norm(q, axis=-1, keepdims=True)
    w, x, y, z = np.moveaxis(unit, -1, 0)
    out = np.empty((*q.shape[:-1], 3, 3), unit.dtype)
    out[..., 0, 0] = 1 - 2 * (y * y + z * z)
    out[..., 0, 1] = 2 * (x * y - w * z)
    out[..., 0, 2] = 2 * (x * z + w * y)
    out[..., 1, 0] = 2 * (x * y + w * z)
    out[..., 1, 1] = 1 - 2 * (x * x + z * z)
    out[..., 1, 2] = 2 * (y * z - w * x)
    out[..., 2, 0] = 2 * (x * z - w * y)
    out[..., 2, 1] = 2 * (y * z + w * x)
    out[..., 2, 2] = 1 - 2 * (x * x + y * y)
    return out


def from_quaternion(translation: Array, q: Array) -> Array:
    """Return T [4, 4] of a translation [3] in meters and a quaternion wxyz [4]."""
    T = np.eye(4)
    T[:3, :3] = rotation(np.asarray(q, float))
    T[:3, 3] = translation
    return T


def transforms_differ(
    T_a: np.ndarray, T_b: np.ndarray, distance_m: float, angle_rad: float
) -> np.ndarray:
    """Return which pairs of transforms differ by more than a distance or an angle.

    Args:
        T_a: Transforms, [K, 4, 4].
        T_b: Transforms, [K, 4, 4].
        distance_m: Distance between the positions above which a pair differs, meters.
        angle_rad: Angle between the rotations above which a pair differs, radians.

    Returns:
        [K] bool; True for pairs that differ.
    """
    T_a, T_b = np.reshape(T_a, (-1, 4, 4)), np.reshape(T_b, (-1, 4, 4))
    apart_m = np.linalg.norm(T_a[:, :3, 3] - T_b[:, :3, 3], axis=1)
    # |R_a - R_b| = 2 sqrt(2) sin(angle / 2); unlike the trace, it keeps all digits at small angles.
    chord = np.linalg.norm(T_a[:, :3, :3] - T_b[:, :3, :3], axis=(1, 2))
    turned_rad = 2 * np.arcsin(np.minimum(chord / np.sqrt(8), 1))
    return (apart_m > distance_m) | (turned_rad > angle_rad)


def interpolate(T_a: np.ndarray, T_b: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Interpolate between pairs of transforms.

        T = T_a (exp(s omega), s t),   (exp(omega), t) = T_a^-1 T_b

    The rotation is about one axis at a constant rate; the translation is on a straight line. The
    result of a pair is bitwise independent of the other pairs of the call.

    Args:
        T_a: Transforms at s = 0, [N, 4, 4].
        T_b: Transforms at s = 1, [N, 4, 4].
        share: Interpolation parameters s, [N].

    Returns:
        [N, 4, 4].
    """
    T_a_b = inverse(T_a) @ T_b
    part = np.zeros_like(T_a_b)
    if len(T_a_b):  # Some supported versions of SciPy reject an empty batch.
        omega = Rotation.from_matrix(T_a_b[:, :3, :3]).as_rotvec()
        part[:, :3, :3] = Rotation.from_rotvec(share[:, None] * omega).as_matrix()
    part[:, :3, 3] = share[:, None] * T_a_b[:, :3, 3]
    part[:, 3, 3] = 1
    return T_a @ part


def fit_rigid_transform(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Fit a rigid transform between corresponding points, without scale.

    It minimizes sum |T p_k - q_k|^2 (Umeyama, PAMI 1991, eq. 40-42) and excludes reflections. If
    all points lie on one line, the residuals are minimal, but the rotation about the line is
    arbitrary.

    Args:
        points: Points p, [M, 3].
        target: Corresponding points q, [M, 3].

    Returns:
        T_target_points, [4, 4].
    """
    mean_p, mean_q = points.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - mean_q).T @ (points - mean_p))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))]) @ Vt
    T[:3, 3] = mean_q - T[:3, :3] @ mean_p
    return T
