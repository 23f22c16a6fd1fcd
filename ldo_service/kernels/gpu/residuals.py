"""Residuals of direct alignment and sums of their normal equations; see `kernels/align.hpp`.

A point has 7 floats: coordinates (3), gray level (1), normal (3). A texel has 4 floats: gray level,
its derivatives along u and v, depth. `tracking.alignment` describes residuals and weights.

A problem has 25 floats: T_camera_reference row by row (12), fx fy cx cy (4), gain, bias, standard
deviation of gray levels, factor on the depth noise, the parameters floor, growth and nearest of
`DepthNoise` (3), and the settings gate and occlusion of `ResidualConfig` (2).

The 51 sums are, in this order: upper triangle of the Hessian row by row (36), gradient (8), number
of visible points (1), and three sums for each kind of residual, photometric first: number of
residuals, number of inliers, sum of weighted squares.
"""

import triton
import triton.language as tl

from .arithmetic import cross, dot, kernel

DEGREES_OF_FREEDOM = tl.constexpr(5.0)  # The constants equal those of `kernels/align.cpp`.
INLIER_SQUARE = tl.constexpr(9.0)  # (3 sigma)^2.
NEAREST = tl.constexpr(1e-3)  # Meters; closer points are not projected.
TEXEL = tl.constexpr(4)
STRIP = tl.constexpr(16)  # Consecutive points that are added to one image cell.
ROWS = tl.constexpr(14)  # Sums of a strip: photometric gradient (8), geometric gradient (6).


@triton.jit
def bilinear(upper, below, k, du, dv, inside):
    """Return value k of the texels, interpolated between four pixels, and the minimum of the four.

    `upper` is the address of the upper left texel, and `below` is the number of floats in a row.
    """
    a, b = tl.load(upper + k, inside, 0.0), tl.load(upper + TEXEL + k, inside, 0.0)
    c, d = tl.load(upper + below + k, inside, 0.0), tl.load(upper + below + TEXEL + k, inside, 0.0)
    top, bottom = a + du * (b - a), c + du * (d - c)
    darkest = tl.minimum(tl.minimum(a, b), tl.minimum(c, d))
    return top + dv * (bottom - top), darkest


@triton.jit
def robust_scale(r, inverse_sigma, used):
    """Return sqrt(w) / sigma, (r / sigma)^2 and the robust weight w of residuals r.

    sqrt(w) / sigma is 0 for residuals that are not used.
    """
    normalized = r * inverse_sigma
    square = normalized * normalized
    weight = tl.div_rn(DEGREES_OF_FREEDOM + 1.0, square + DEGREES_OF_FREEDOM)
    return tl.where(used, tl.sqrt_rn(weight) * inverse_sigma, 0.0), square, weight


@triton.jit
def store_sum(out, k, n_programs, values):
    tl.store(out + k * n_programs + tl.program_id(0), tl.sum(values, 0))


@triton.jit
def store_statistics(out, k, n_programs, used, square, weight):
    store_sum(out, k, n_programs, tl.where(used, 1.0, 0.0))
    store_sum(out, k + 1, n_programs, tl.where(used & (square < INLIER_SQUARE), 1.0, 0.0))
    store_sum(out, k + 2, n_programs, tl.where(used, weight * square, 0.0))


@triton.jit
def store_strips(strips, k, n, values, BLOCK: tl.constexpr):
    """Sum `values` over strips of 16 consecutive points; write the sums to row k of `strips`."""
    n_strips = (n + STRIP - 1) // STRIP
    strip = tl.program_id(0) * (BLOCK // STRIP) + tl.arange(0, BLOCK // STRIP)
    sums = tl.sum(tl.reshape(values, [BLOCK // STRIP, STRIP]), 1)
    tl.store(strips + k * n_strips + strip, sums, strip < n_strips)


@triton.jit
def project_points(points, i, live, n, R0, R1, R2, t, lens, width, height):
    """Return the points in the camera frame, their pixels, and whether they lie in the image.

    Points outside of the image get the coordinates (0, 0, 1) and the pixel (0, 0), so all values
    are finite.
    """
    fx, fy, cx, cy = lens
    P = (
        tl.load(points + i, live, 0.0),
        tl.load(points + n + i, live, 0.0),
        tl.load(points + 2 * n + i, live, 0.0),
    )
    x, y, z = dot(P, R0) + t[0], dot(P, R1) + t[1], dot(P, R2) + t[2]
    in_front = live & (P[2] > 0.0) & (z > NEAREST)
    z = tl.where(in_front, z, 1.0)
    inverse_z = tl.div_rn(1.0, z)
    u, v = fx * x * inverse_z + cx, fy * y * inverse_z + cy
    inside = in_front & (u >= 1.0) & (v >= 1.0)
    inside = inside & (u < width.to(tl.float32) - 2.0) & (v < height.to(tl.float32) - 2.0)
    x, y, z = tl.where(inside, x, 0.0), tl.where(inside, y, 0.0), tl.where(inside, z, 1.0)
    return (x, y, z), tl.where(inside, u, 0.0), tl.where(inside, v, 0.0), inside


@triton.jit
def photometric(p, shade, gray, slope_u, slope_v, used, problem, lens):
    """Return weighted rows [J | r] of photometric residuals, (r / sigma)^2 and the weights w.

    A residual is r = gray - gain shade - bias, where `shade` is the gray level of the reference
    point. Each row is multiplied by sqrt(w) / sigma. Rows of unused residuals are 0.
    """
    gain, bias = tl.load(problem + 16), tl.load(problem + 17)
    inverse_sigma = tl.div_rn(1.0, tl.load(problem + 18))
    shade = tl.where(used, shade, 0.0)
    inverse_z = tl.div_rn(1.0, p[2])
    gx = tl.where(used, slope_u, 0.0) * lens[0] * inverse_z
    gy = tl.where(used, slope_v, 0.0) * lens[1] * inverse_z
    g = (gx, gy, 0.0 - (gx * p[0] + gy * p[1]) * inverse_z)
    r = tl.where(used, gray, 0.0) - gain * shade - bias
    s, square, weight = robust_scale(r, inverse_sigma, used)
    turn = cross(g, p)
    rows = (
        s * turn[0],
        s * turn[1],
        s * turn[2],
        0.0 - s * g[0],
        0.0 - s * g[1],
        0.0 - s * g[2],
        0.0 - s * shade,
        0.0 - s,
        s * r,
    )
    return rows, square, weight


@triton.jit
def geometric(p, normal, q, used, problem):
    """Return weighted rows [J | r] of geometric residuals, (r / sigma)^2 and the weights w.

    A residual is r = normal . (p - q), where q is the measured point. Each row is multiplied by
    sqrt(w) / sigma. J has 6 columns, because gain and bias have no effect. Rows of unused residuals
    are 0.
    """
    noise_scale, floor = tl.load(problem + 19), tl.load(problem + 20)
    growth, nearest = tl.load(problem + 21), tl.load(problem + 22)
    n = (
        tl.where(used, normal[0], 0.0),
        tl.where(used, normal[1], 0.0),
        tl.where(used, normal[2], 0.0),
    )
    r = n[0] * (p[0] - q[0]) + n[1] * (p[1] - q[1]) + n[2] * (p[2] - q[2])
    beyond = p[2] - nearest
    inverse_sigma = tl.div_rn(1.0, noise_scale * (floor + growth * beyond * beyond))
    s, square, weight = robust_scale(r, inverse_sigma, used)
    turn = cross(n, q)
    rows = (
        s * turn[0],
        s * turn[1],
        s * turn[2],
        0.0 - s * n[0],
        0.0 - s * n[1],
        0.0 - s * n[2],
        s * r,
    )
    return rows, square, weight


@kernel
def sum_residuals(
    points,
    n,
    texels,
    width,
    height,
    problem,
    n_programs,
    out,
    strips,
    WITH_STRIPS: tl.constexpr,
    BLOCK: tl.constexpr,
):
    """Compute the residuals of BLOCK points, and sum their normal equations.

    The module describes the layouts of points, texels, problem and sums.

    Args:
        points: Reference points, [7, n].
        n: Number of points.
        texels: Image and depth of the frame, [height, width, 4].
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        problem: Pose, camera and settings, [25].
        n_programs: Number of Triton programs.
        out: Output, [51, n_programs]: sums of each program.
        strips: Output if WITH_STRIPS is true, [14, ceil(n / 16)]: photometric gradient (8), then
            geometric gradient (6), of each strip of 16 consecutive points.
        WITH_STRIPS: True to write `strips`.
        BLOCK: Number of points of a Triton program, a multiple of 16.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    live = i < n
    R0 = (tl.load(problem), tl.load(problem + 1), tl.load(problem + 2))
    R1 = (tl.load(problem + 4), tl.load(problem + 5), tl.load(problem + 6))
    R2 = (tl.load(problem + 8), tl.load(problem + 9), tl.load(problem + 10))
    t = (tl.load(problem + 3), tl.load(problem + 7), tl.load(problem + 11))
    fx, fy = tl.load(problem + 12), tl.load(problem + 13)
    cx, cy = tl.load(problem + 14), tl.load(problem + 15)
    lens = (fx, fy, cx, cy)
    p, u, v, inside = project_points(points, i, live, n, R0, R1, R2, t, lens, width, height)
    column, row = u.to(tl.int32), v.to(tl.int32)
    du, dv = u - column.to(tl.float32), v - row.to(tl.float32)
    upper, below = texels + (row * width + column) * TEXEL, width * TEXEL
    gray, darkest = bilinear(upper, below, 0, du, dv, inside)
    slope_u, _ = bilinear(upper, below, 1, du, dv, inside)
    slope_v, _ = bilinear(upper, below, 2, du, dv, inside)
    column, row = (u + 0.5).to(tl.int32), (v + 0.5).to(tl.int32)
    seen = tl.load(texels + (row * width + column) * TEXEL + 3, inside, 0.0)
    visible = inside & ~((seen > 0.0) & (p[2] > seen * (1.0 + tl.load(problem + 24))))

    shade = tl.load(points + 3 * n + i, live, 0.0)
    compared = visible & (shade > 0.0) & (darkest > 0.0) & (gray > 0.0)
    compared = compared & (shade * 0.0 >= 0.0)  # The gray level of the point is finite.
    C, square, weight = photometric(p, shade, gray, slope_u, slope_v, compared, problem, lens)
    store_sum(out, 44, n_programs, tl.where(visible, 1.0, 0.0))
    store_statistics(out, 45, n_programs, compared, square, weight)

    m = (
        tl.load(points + 4 * n + i, live, 0.0),
        tl.load(points + 5 * n + i, live, 0.0),
        tl.load(points + 6 * n + i, live, 0.0),
    )
    normal = (dot(m, R0), dot(m, R1), dot(m, R2))
    size = dot(normal, normal)
    paired = visible & (seen > 0.0) & (size > 0.5) & (size * 0.0 >= 0.0)
    paired = paired & (tl.abs(p[2] - seen) < tl.load(problem + 23) * p[2])
    depth = tl.where(paired, seen, 0.0)
    qx = (column.to(tl.float32) - cx) * tl.div_rn(1.0, fx) * depth
    qy = (row.to(tl.float32) - cy) * tl.div_rn(1.0, fy) * depth
    G, square, weight = geometric(p, normal, (qx, qy, depth), paired, problem)
    store_statistics(out, 48, n_programs, paired, square, weight)

    for j in tl.static_range(8):
        for k in tl.static_range(j, 9):
            products = C[j] * C[k]
            # Geometric residuals do not depend on gain and bias, columns 6 and 7.
            if j < 6:
                if k < 6:
                    products += G[j] * G[k]
                if k == 8:
                    products += G[j] * G[6]
            if k < 8:
                store_sum(out, j * 8 - j * (j - 1) // 2 + k - j, n_programs, products)
            else:
                store_sum(out, 36 + j, n_programs, products)
    if WITH_STRIPS:
        for j in tl.static_range(8):
            store_strips(strips, j, n, C[j] * C[8], BLOCK)
        for j in tl.static_range(6):
            store_strips(strips, 8 + j, n, G[j] * G[6], BLOCK)


@kernel
def add_programs(sums, n, out, LANES: tl.constexpr):
    """Add up each row of `sums` in double precision.

    Args:
        sums: Sums of `sum_residuals`, [rows, n]; each Triton program wrote one column.
        n: Number of columns.
        out: Output, [rows] float64.
        LANES: Number of partial sums that are computed in parallel.
    """
    row, lane = tl.program_id(0), tl.arange(0, LANES)
    total = tl.zeros([LANES], tl.float64)
    for start in range(0, n, LANES):
        total += tl.load(sums + row * n + start + lane, start + lane < n, 0.0).to(tl.float64)
    tl.store(out + row, tl.sum(total, 0))


@kernel
def add_strips(strips, cells, n, out, LANES: tl.constexpr):
    """Add up the gradients of all strips of each image cell in double precision.

    Args:
        strips: Gradients of `sum_residuals`, [14, n]: photometric (8), then geometric (6).
        cells: Number of the image cell of each strip, [n] uint8.
        n: Number of strips.
        out: Output, [64, 14] float64: one row per image cell.
        LANES: Number of partial sums that are computed in parallel.
    """
    cell = tl.program_id(0)
    row, lane = tl.arange(0, 16), tl.arange(0, LANES)
    total = tl.zeros([16, LANES], tl.float64)
    for start in range(0, n, LANES):
        live = start + lane < n
        own = live & (tl.load(cells + start + lane, live, 0) == cell)
        at = strips + row[:, None] * n + (start + lane)[None, :]
        values = tl.load(at, (row < ROWS)[:, None] & own[None, :], 0.0)
        total += values.to(tl.float64)
    tl.store(out + cell * ROWS + row, tl.sum(total, 1), row < ROWS)
