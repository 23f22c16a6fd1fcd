"""Projection gradient and step of Adam in one kernel; see `kernels/projection_gradient.hpp`."""

import triton
import triton.language as tl

from .arithmetic import add_scaled, cross, dot, exp, kernel, log
from .projection import (
    NEAR,
    ROW,
    camera_of,
    image_covariance,
    jacobian,
    load_row,
    principal_axes,
    quaternion_gradient,
    to_camera,
)


@triton.jit
def needle_gradient(scale, push, log_ratio):
    """Return the derivatives of the needle penalty with respect to the log scales.

    A needle is a Gaussian with one long axis. The penalty is
    push * max(0, log(longest axis / middle axis) - log_ratio). `push` is the weight of the penalty
    times the mean blending weight of the Gaussian over the pixels.
    """
    longest = tl.maximum(scale[0], tl.maximum(scale[1], scale[2]))
    low, high = tl.minimum(scale[0], scale[1]), tl.maximum(scale[0], scale[1])
    middle = tl.maximum(low, tl.minimum(high, scale[2]))
    push = tl.where(longest - middle >= log_ratio, push, 0.0)
    return (
        tl.where(scale[0] >= longest, push, 0.0) - tl.where(scale[0] == middle, push, 0.0),
        tl.where(scale[1] >= longest, push, 0.0) - tl.where(scale[1] == middle, push, 0.0),
        tl.where(scale[2] >= longest, push, 0.0) - tl.where(scale[2] == middle, push, 0.0),
    )


@triton.jit
def only_at(numbers, number, value):
    """Return `value` where `numbers` equals `number`, and 0 elsewhere."""
    return tl.where(numbers == number, value, 0.0)


@triton.jit
def sums_of_pairs(sums, first, count, BLOCK: tl.constexpr):
    """Return the eleven sums of each splat, added up over its pairs.

    `blend_backward` writes one row of `sums` for each pair of a splat and a tile, and lists the
    eleven sums. The pairs of a splat are `count` rows, from row `first` on.
    """
    zero = tl.zeros([BLOCK], tl.float32)
    V, Vx, Vy, Vxx, Vxy, Vyy = zero, zero, zero, zero, zero, zero
    red, green, blue, depth, weight = zero, zero, zero, zero, zero
    for k in range(tl.max(count)):
        has_pair = k < count
        at = sums + (first + k).to(tl.int64) * 16
        V += tl.load(at, has_pair, 0.0)
        Vx += tl.load(at + 1, has_pair, 0.0)
        Vy += tl.load(at + 2, has_pair, 0.0)
        Vxx += tl.load(at + 3, has_pair, 0.0)
        Vxy += tl.load(at + 4, has_pair, 0.0)
        Vyy += tl.load(at + 5, has_pair, 0.0)
        red += tl.load(at + 6, has_pair, 0.0)
        green += tl.load(at + 7, has_pair, 0.0)
        blue += tl.load(at + 8, has_pair, 0.0)
        depth += tl.load(at + 9, has_pair, 0.0)
        weight += tl.load(at + 10, has_pair, 0.0)
    return V, Vx, Vy, Vxx, Vxy, Vyy, red, green, blue, depth, weight


@triton.jit
def covariance_gradient(V, Vx, Vy, Vxx, Vxy, Vyy, covariance, box):
    """Return the derivatives of the loss L with respect to a splat's center and covariance.

    Args:
        V: Sum of v = dL/d(ln alpha) over the pixels.
        Vx: Sum of v d_x over the pixels; d is the offset of a pixel from the center (u, v), px.
        Vy: Sum of v d_y.
        Vxx: Sum of v d_x d_x.
        Vxy: Sum of v d_x d_y.
        Vyy: Sum of v d_y d_y.
        covariance: Entries (uu, uv, vv) of the image covariance, px^2.
        box: Variance of the box filter of binning, px^2; 0 without binning.

    Returns:
        Derivatives with respect to u and v, then twice the derivatives with respect to uu, uv and
        vv.
    """
    # K is the inverse of the covariance S: dL/dmean = K sum(v d) and 2 dL/dS = K sum(v d d') K.
    uu, uv, vv = covariance
    inverse = tl.div_rn(1.0, uu * vv - uv * uv)
    Kuu, Kuv, Kvv = vv * inverse, 0.0 - uv * inverse, uu * inverse
    by_u, by_v = Kuu * Vx + Kuv * Vy, Kuv * Vx + Kvv * Vy
    left_uu, left_uv = Kuu * Vxx + Kuv * Vxy, Kuu * Vxy + Kuv * Vyy
    left_vu, left_vv = Kuv * Vxx + Kvv * Vxy, Kuv * Vxy + Kvv * Vyy
    Suu, Suv = left_uu * Kuu + left_uv * Kuv, left_uu * Kuv + left_uv * Kvv
    Svv = left_vu * Kuv + left_vv * Kvv
    # Binning adds the term ln(|S - box I| / |S|) / 2 to ln alpha.
    is_binned = box > 0.0
    nn, mm = uu - box, vv - box
    narrow = tl.div_rn(V, nn * mm - uv * uv)
    Suu = tl.where(is_binned, Suu + mm * narrow - V * Kuu, Suu)
    Suv = tl.where(is_binned, Suv - uv * narrow - V * Kuv, Suv)
    Svv = tl.where(is_binned, Svv + nn * narrow - V * Kvv, Svv)
    return by_u, by_v, (Suu, Suv, Svv)


@triton.jit
def shape_gradient(q, axes, sigmas, jacobian_rows, along, by_covariance):
    """Return the derivatives of the loss with respect to log scales, quaternion and Jacobian.

    Args:
        q: Quaternion of any length.
        axes: Principal axes in the map frame, each as long as its standard deviation.
        sigmas: Standard deviations along the axes, meters.
        jacobian_rows: Rows du and dv of the Jacobian, in the map frame.
        along: Scalar products of du with the three axes, and of dv with the three axes.
        by_covariance: Twice the derivatives with respect to the entries uu, uv and vv of the image
            covariance.

    Returns:
        Derivatives with respect to the three log scales, the quaternion, du and dv.
    """
    # The covariance is the low pass plus the sum over axes a of (du.a, dv.a) (du.a, dv.a)'.
    a0, a1, a2 = axes
    du, dv = jacobian_rows
    along_u, along_v = along
    Suu, Suv, Svv = by_covariance
    m0 = Suu * along_u[0] + Suv * along_v[0]
    m1 = Suu * along_u[1] + Suv * along_v[1]
    m2 = Suu * along_u[2] + Suv * along_v[2]
    n0 = Suv * along_u[0] + Svv * along_v[0]
    n1 = Suv * along_u[1] + Svv * along_v[1]
    n2 = Suv * along_u[2] + Svv * along_v[2]
    zero = tl.zeros_like(Suu)
    none = (zero, zero, zero)
    by_du = add_scaled(add_scaled(add_scaled(none, a0, m0), a1, m1), a2, m2)
    by_dv = add_scaled(add_scaled(add_scaled(none, a0, n0), a1, n1), a2, n2)
    g0 = add_scaled(add_scaled(none, du, m0 * sigmas[0]), dv, n0 * sigmas[0])
    g1 = add_scaled(add_scaled(none, du, m1 * sigmas[1]), dv, n1 * sigmas[1])
    g2 = add_scaled(add_scaled(none, du, m2 * sigmas[2]), dv, n2 * sigmas[2])
    by_scale = (
        m0 * along_u[0] + n0 * along_v[0],
        m1 * along_u[1] + n1 * along_v[1],
        m2 * along_u[2] + n2 * along_v[2],
    )
    return by_scale, quaternion_gradient(q, g0, g1, g2), by_du, by_dv


@triton.jit
def point_gradient(p, inverse_z, slopes, limits, perspective, by_uv, row_u, row_v, depth):
    """Return the derivative of the loss with respect to the point p in the camera frame.

    Args:
        p: Point in the camera frame, meters.
        inverse_z: 1 / z of the point.
        slopes: x / z and y / z of the point.
        limits: Bounds (x min, x max, y min, y max) to which the Jacobian clamps the slopes.
        perspective: Entries (ju, jv, ku, kv) of the Jacobian; see `projection.jacobian`.
        by_uv: Derivatives of the loss with respect to the image position (u, v).
        row_u: Derivative with respect to the row of u of the Jacobian, in the camera frame.
        row_v: Derivative with respect to the row of v of the Jacobian, in the camera frame.
        depth: Derivative with respect to the depth z of the point in the depth image.
    """
    ju, jv, ku, kv = perspective
    by_u, by_v = by_uv
    x, y = slopes
    moves_u = tl.where((x >= limits[0]) & (x <= limits[1]), 1.0, 0.0)
    moves_v = tl.where((y >= limits[2]) & (y <= limits[3]), 1.0, 0.0)
    pull = by_u * ju * p[0] + by_v * jv * p[1] + ju * row_u[0] + jv * row_v[1]
    pull = pull - (moves_u + 1.0) * ku * row_u[2] - (moves_v + 1.0) * kv * row_v[2]
    return (
        ju * (by_u - moves_u * inverse_z * row_u[2]),
        jv * (by_v - moves_v * inverse_z * row_v[2]),
        depth - inverse_z * pull,
    )


@triton.jit
def store_pose(by_pose, p, g, perspective, row_u, row_v, is_live):
    """Store the derivatives with respect to the pose, summed over the Gaussians of the program.

    Args:
        by_pose: Output, [programs, 8]: derivatives with respect to rotation (3) and translation
            (3), then two zeros.
        p: Point in the camera frame.
        g: Derivative of the loss with respect to p.
        perspective: (ju, jv, ku, kv); see `projection.jacobian`.
        row_u: Derivative with respect to the row of u of the Jacobian, in the camera frame.
        row_v: Derivative with respect to the row of v of the Jacobian, in the camera frame.
        is_live: True for lanes that have a Gaussian.
    """
    ju, jv, ku, kv = perspective
    # T_camera_map' = exp(-xi) T_camera_map rotates and moves the point and the rows of J R.
    turn = cross(p, g)
    turn_u, turn_v = cross(row_u, (ju, 0.0, 0.0 - ku)), cross(row_v, (0.0, jv, 0.0 - kv))
    number = tl.arange(0, 8)
    pose = tl.zeros([8], tl.float32)
    for j in tl.static_range(3):
        rotation = tl.where(is_live, 0.0 - turn[j] - turn_u[j] - turn_v[j], 0.0)
        pose += only_at(number, j, tl.sum(rotation, 0))
        pose += only_at(number, j + 3, tl.sum(tl.where(is_live, 0.0 - g[j], 0.0), 0))
    tl.store(by_pose + tl.program_id(0) * 8 + number, pose)


@triton.jit
def take_step(
    rows, i, gradient, is_live, camera, state, adam, max_sigma_per_depth, LAST_STEP: tl.constexpr
):
    """Take a step of Adam in place, and limit the standard deviations of the Gaussians.

    Args:
        rows: Gaussians, [N, 16]; changed in place.
        i: Index of the Gaussian of each lane.
        gradient: Derivatives with respect to the 16 columns of `rows`; the last one is 0.
        is_live: True for lanes that have a Gaussian.
        camera: Third row of the rotation matrix, and the translation, of T_camera_map.
        state: `moments`, `squares` and `steps` of `project_backward`.
        adam: `rates`, `corrections`, `beta1`, `beta2` and `epsilon` of `project_backward`.
        max_sigma_per_depth: Maximum standard deviation after the step, as a fraction of the depth.
        LAST_STEP: Number of steps after which the bias correction of Adam stays constant.
    """
    R2, t = camera
    moments, squares, steps = state
    rates, corrections, beta1, beta2, epsilon = adam
    at = i.to(tl.int64) * ROW
    # A row whose gradient is zero is hidden; it keeps its values, moments and step count.
    is_moved = is_live & (i < 0)
    for j in tl.static_range(16):
        is_moved = is_moved | (is_live & (tl.abs(gradient[j]) > 0.0))
    step = tl.load(steps + i, is_moved, 0) + 1
    tl.store(steps + i, step, is_moved)
    step = tl.minimum(step, LAST_STEP)
    of_mean = tl.load(corrections + step * 2, is_moved, 1.0)
    of_square = tl.load(corrections + step * 2 + 1, is_moved, 1.0)
    z = gradient[15]
    for j in tl.static_range(16):
        m, s = moments + at + j, squares + at + j
        value, rate = tl.load(rows + at + j, is_moved, 0.0), tl.load(rates + j)
        new_m = tl.load(m, is_moved, 0.0) * beta1 + gradient[j] * (1.0 - beta1)
        new_s = tl.load(s, is_moved, 0.0) * beta2 + gradient[j] * gradient[j] * (1.0 - beta2)
        tl.store(m, new_m, is_moved)
        tl.store(s, new_s, is_moved)
        root = tl.sqrt_rn(new_s * of_square) + epsilon
        value = value - tl.div_rn(rate * of_mean * new_m, root)
        if j < 3:
            z += value * R2[j]
        if (j >= 3) & (j < 6):
            limit = max_sigma_per_depth * tl.maximum(z + t[2], NEAR)
            value = tl.minimum(value, log(limit))
        tl.store(rows + at + j, value, is_moved)


@kernel
def project_backward(
    rows,
    view,
    width,
    height,
    visible,
    n_visible,
    firsts,
    pairs,
    sums,
    by_rows,
    moments,
    squares,
    steps,
    rates,
    corrections,
    beta1,
    beta2,
    epsilon,
    needle_weight,
    needle_log_ratio,
    max_sigma_per_depth,
    weights,
    by_pose,
    LAST_STEP: tl.constexpr,
    ADAM: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the derivatives with respect to the Gaussians, or take a step of Adam with them.

    Args:
        rows: Gaussians, [N, 16]; changed if ADAM is true.
        view: View, [18]; the module `projection` describes the layout.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        visible: Indices of the drawn Gaussians, [n_visible], ascending; each lane computes one.
        n_visible: Number of drawn Gaussians.
        firsts: Index of each splat's first row in `sums`, [N].
        pairs: Number of each splat's rows in `sums`, one row per tile, [N].
        sums: Output of `blend_backward`, [P, 16].
        by_rows: Output if ADAM is false, [n_visible, 16]: derivatives with respect to `rows`.
            Column 14 is the blending weight summed over the pixels.
        moments: First moments of Adam, [N, 16]; changed if ADAM is true.
        squares: Second moments of Adam, [N, 16]; changed if ADAM is true.
        steps: Number of steps that each Gaussian has taken, [N]; changed if ADAM is true.
        rates: Learning rates of the columns of `rows`, [16].
        corrections: Bias corrections 1 / (1 - beta^steps) of first and second moments,
            [LAST_STEP + 1, 2].
        beta1: Decay of the first moments.
        beta2: Decay of the second moments.
        epsilon: Positive term that keeps the denominator of the step from zero.
        needle_weight: Weight of the penalty on needles, which are Gaussians with one long axis.
        needle_log_ratio: Logarithm of the axis ratio above which the penalty applies.
        max_sigma_per_depth: Maximum standard deviation after the step, as a fraction of the depth.
        weights: Output, [n_visible]: blending weight of each Gaussian summed over the pixels.
        by_pose: Output, [programs, 8]: derivatives with respect to xi of T_map_camera exp(xi):
            rotation (3), translation (3), two zeros. The caller sums them over the programs.
        LAST_STEP: Number of steps after which the bias correction of Adam stays constant.
        ADAM: True to take a step of Adam, false to write the derivatives.
        BLOCK: Number of lanes of a Triton program.
    """
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_live = lane < n_visible
    i = tl.load(visible + lane, is_live, 0)
    first, count = tl.load(firsts + i, is_live, 0), tl.load(pairs + i, is_live, 0)
    V, Vx, Vy, Vxx, Vxy, Vyy, red, green, blue, depth, weight = sums_of_pairs(
        sums, first, count, BLOCK
    )
    zero = tl.zeros([BLOCK], tl.float32)

    mean, scale, q, opacity, _color = load_row(rows, i, is_live)
    R0, R1, R2, t, lens, limits, filters = camera_of(view, width, height)
    p = to_camera(mean, R0, R1, R2, t)
    du, dv, inverse_z, x, y, perspective = jacobian(p, R0, R1, R2, lens, limits)
    sigmas = exp(scale[0]), exp(scale[1]), exp(scale[2])
    a0, a1, a2 = principal_axes(q, sigmas)
    along_u = (dot(du, a0), dot(du, a1), dot(du, a2))
    along_v = (dot(dv, a0), dot(dv, a1), dot(dv, a2))
    low_pass, box = filters
    covariance = image_covariance(along_u, along_v, low_pass)
    by_u, by_v, by_covariance = covariance_gradient(V, Vx, Vy, Vxx, Vxy, Vyy, covariance, box)

    by_scale, by_q, by_du, by_dv = shape_gradient(
        q, (a0, a1, a2), sigmas, (du, dv), (along_u, along_v), by_covariance
    )
    size = width.to(tl.float32) * height.to(tl.float32)
    push = weight * tl.div_rn(needle_weight, size)
    needle = needle_gradient(scale, push, needle_log_ratio)

    # The derivative passes the Jacobian and the perspective to the point in the camera frame.
    row_u = (dot(R0, by_du), dot(R1, by_du), dot(R2, by_du))
    row_v = (dot(R0, by_dv), dot(R1, by_dv), dot(R2, by_dv))
    g = point_gradient(p, inverse_z, (x, y), limits, perspective, (by_u, by_v), row_u, row_v, depth)
    gradient = (
        g[0] * R0[0] + g[1] * R1[0] + g[2] * R2[0],
        g[0] * R0[1] + g[1] * R1[1] + g[2] * R2[1],
        g[0] * R0[2] + g[1] * R1[2] + g[2] * R2[2],
        by_scale[0] + needle[0],
        by_scale[1] + needle[1],
        by_scale[2] + needle[2],
        by_q[0],
        by_q[1],
        by_q[2],
        by_q[3],
        tl.div_rn(V, 1.0 + exp(opacity)),
        red,
        green,
        blue,
        weight,
        zero,
    )

    store_pose(by_pose, p, g, perspective, row_u, row_v, is_live)
    tl.store(weights + lane, weight, is_live)

    if ADAM:
        take_step(
            rows,
            i,
            gradient,
            is_live,
            (R2, t),
            (moments, squares, steps),
            (rates, corrections, beta1, beta2, epsilon),
            max_sigma_per_depth,
            LAST_STEP,
        )
    else:
        for j in tl.static_range(16):
            tl.store(by_rows + lane.to(tl.int64) * ROW + j, gradient[j], is_live)
