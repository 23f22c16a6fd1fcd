"""Projection of Gaussians to splats, and pairs of splats and tiles; see `kernels/projection.hpp`.

A Gaussian is a row of 16 floats. Its columns are: mean 0-2, log scale 3-5, quaternion wxyz 6-9,
opacity logit 10, color 11-13, unused 14-15.

A splat, the projection of a Gaussian, has 16 floats: u v | a b c log2_opacity | x_slope y_slope |
red green blue | z | four unused. At the offset (x, y) from its center (u, v) in pixels, log2 of
alpha is a x^2 + b x y + c y^2 + log2_opacity. Alpha is largest at x = x_slope y for a given y, and
at y = y_slope x for a given x.

A view has 18 floats: T_camera_map row by row (12), fx fy cx cy, low_pass, box. The last two are
variances in px^2. low_pass is added to the covariance of each splat. box is the part of low_pass
that stands for the averaging of full-image pixels in a binned image.

A pair is a splat and a tile of 16x16 pixels that it may reach. A tile has 16 blocks of 4x4 pixels.
"""

import triton
import triton.language as tl

from .arithmetic import LOG2_E, clamp, dot, exp, kernel, log2

ROW = tl.constexpr(16)
NEAR = tl.constexpr(0.05)  # Near plane, meters.
LOG2_MIN_ALPHA = tl.constexpr(-7.99435344)  # log2(1 / 255); weaker contributions are dropped.
TILE = tl.constexpr(16)  # Pixels.


@triton.jit
def camera_of(view, width, height):
    """Return the three rows of the rotation, the translation, the lens, the limits and the filter.

    The lens is (fx, fy, cx, cy). The limits are the bounds to which `jacobian` clamps x / z and
    y / z. The filter is (low_pass, box), which the module describes together with `view`.
    """
    R0 = (tl.load(view), tl.load(view + 1), tl.load(view + 2))
    R1 = (tl.load(view + 4), tl.load(view + 5), tl.load(view + 6))
    R2 = (tl.load(view + 8), tl.load(view + 9), tl.load(view + 10))
    t = (tl.load(view + 3), tl.load(view + 7), tl.load(view + 11))
    fx, fy, cx, cy = tl.load(view + 12), tl.load(view + 13), tl.load(view + 14), tl.load(view + 15)
    w, h = width.to(tl.float32), height.to(tl.float32)
    margin_x, margin_y = tl.div_rn(0.15 * w, fx), tl.div_rn(0.15 * h, fy)
    limits = (
        tl.div_rn(0.0 - cx, fx) - margin_x,
        tl.div_rn(w - cx, fx) + margin_x,
        tl.div_rn(0.0 - cy, fy) - margin_y,
        tl.div_rn(h - cy, fy) + margin_y,
    )
    return R0, R1, R2, t, (fx, fy, cx, cy), limits, (tl.load(view + 16), tl.load(view + 17))


@triton.jit
def to_camera(mean, R0, R1, R2, t):
    return dot(mean, R0) + t[0], dot(mean, R1) + t[1], dot(mean, R2) + t[2]


@triton.jit
def jacobian(p, R0, R1, R2, lens, limits):
    """Return the derivatives of the pixel (u, v) with respect to a point, and intermediate values.

    p = (x, y, z) is the point in the camera frame, and the derivatives are with respect to the
    point in the map frame. `camera_of` describes the other arguments. The intermediate values are
    1 / z, x / z, y / z and (ju, jv, ku, kv). With respect to p, the derivative of u is
    (ju, 0, -ku), and the derivative of v is (0, jv, -kv). The slopes x / z and y / z in ku and kv
    are clamped to `limits`, because the affine approximation fails outside of these limits.
    """
    inverse_z = tl.div_rn(1.0, tl.maximum(p[2], NEAR))
    x, y = p[0] * inverse_z, p[1] * inverse_z
    ju, jv = inverse_z * lens[0], inverse_z * lens[1]
    ku, kv = ju * clamp(x, limits[0], limits[1]), jv * clamp(y, limits[2], limits[3])
    du = (ju * R0[0] - ku * R2[0], ju * R0[1] - ku * R2[1], ju * R0[2] - ku * R2[2])
    dv = (jv * R1[0] - kv * R2[0], jv * R1[1] - kv * R2[1], jv * R1[2] - kv * R2[2])
    return du, dv, inverse_z, x, y, (ju, jv, ku, kv)


@triton.jit
def principal_axes(q, sigmas):
    """Return the columns of the rotation matrix of a quaternion, scaled by `sigmas`.

    The quaternion may have any length.
    """
    w, x, y, z = q[0], q[1], q[2], q[3]
    s = tl.div_rn(2.0, w * w + x * x + y * y + z * z)
    sx, sy, sz = s * x, s * y, s * z
    xx, yy, zz = sx * x, sy * y, sz * z
    xy, xz, yz = sx * y, sx * z, sy * z
    wx, wy, wz = sx * w, sy * w, sz * w
    a0 = ((1.0 - yy - zz) * sigmas[0], (xy + wz) * sigmas[0], (xz - wy) * sigmas[0])
    a1 = ((xy - wz) * sigmas[1], (1.0 - xx - zz) * sigmas[1], (yz + wx) * sigmas[1])
    a2 = ((xz + wy) * sigmas[2], (yz - wx) * sigmas[2], (1.0 - xx - yy) * sigmas[2])
    return a0, a1, a2


@triton.jit
def quaternion_gradient(q, g0, g1, g2):
    """Return the derivatives with respect to a quaternion from those of its rotation matrix.

    g0, g1 and g2 are the derivatives with respect to the columns of the matrix. The quaternion may
    have any length. Its length has no effect, so the radial part of the gradient is removed.
    """
    shorten = tl.div_rn(1.0, tl.sqrt_rn(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]))
    w, x, y, z = q[0] * shorten, q[1] * shorten, q[2] * shorten, q[3] * shorten
    by_w = x * (g1[2] - g2[1]) + y * (g2[0] - g0[2]) + z * (g0[1] - g1[0])
    by_x = w * (g1[2] - g2[1]) + y * (g1[0] + g0[1]) + z * (g2[0] + g0[2])
    by_x = by_x - x * 2.0 * (g1[1] + g2[2])
    by_y = w * (g2[0] - g0[2]) + x * (g1[0] + g0[1]) + z * (g2[1] + g1[2])
    by_y = by_y - y * 2.0 * (g0[0] + g2[2])
    by_z = w * (g0[1] - g1[0]) + x * (g2[0] + g0[2]) + y * (g2[1] + g1[2])
    by_z = by_z - z * 2.0 * (g0[0] + g1[1])
    radial = w * by_w + x * by_x + y * by_y + z * by_z
    twice = shorten * 2.0
    return (
        (by_w - w * radial) * twice,
        (by_x - x * radial) * twice,
        (by_y - y * radial) * twice,
        (by_z - z * radial) * twice,
    )


@triton.jit
def image_covariance(along_u, along_v, low_pass):
    """Return the entries uu, uv and vv of the covariance of a splat, px^2.

    `along_u` and `along_v` are the u and v components of the three projected axes, px. Each axis of
    the Gaussian is one standard deviation long. `low_pass` is added to both variances, px^2.
    """
    uu = low_pass + along_u[0] * along_u[0] + along_u[1] * along_u[1] + along_u[2] * along_u[2]
    uv = along_u[0] * along_v[0] + along_u[1] * along_v[1] + along_u[2] * along_v[2]
    vv = low_pass + along_v[0] * along_v[0] + along_v[1] * along_v[1] + along_v[2] * along_v[2]
    return uu, uv, vv


@triton.jit
def load_row(rows, i, is_live):
    """Return mean, log scales, quaternion, opacity logit and color of the Gaussians with index i.

    Lanes that are not live get the identity quaternion, and zeros for the other values.
    """
    at = rows + i.to(tl.int64) * ROW
    mean = (tl.load(at, is_live, 0.0), tl.load(at + 1, is_live, 0.0), tl.load(at + 2, is_live, 0.0))
    scale = (
        tl.load(at + 3, is_live, 0.0),
        tl.load(at + 4, is_live, 0.0),
        tl.load(at + 5, is_live, 0.0),
    )
    q = (
        tl.load(at + 6, is_live, 1.0),
        tl.load(at + 7, is_live, 0.0),
        tl.load(at + 8, is_live, 0.0),
        tl.load(at + 9, is_live, 0.0),
    )
    opacity = tl.load(at + 10, is_live, 0.0)
    color = (
        tl.load(at + 11, is_live, 0.0),
        tl.load(at + 12, is_live, 0.0),
        tl.load(at + 13, is_live, 0.0),
    )
    return mean, scale, q, opacity, color


@triton.jit
def pixels_within(center, radius, size):
    """Return the first and last pixel within `radius` of `center`, and whether one exists.

    Pixels are the integers in [0, size).
    """
    edge = size.to(tl.float32) - 1.0
    low, high = center - radius, center + radius
    # NaN fails this comparison. It must come first, because the maximum of NaN and 0 is 0 on a GPU.
    is_near = (low <= edge) & (high >= 0.0)
    low, high = tl.maximum(low, 0.0), tl.minimum(high, edge)
    low, high = tl.where(is_near, low, 0.0), tl.where(is_near, high, 0.0)
    first, last = low.to(tl.int32), high.to(tl.int32)
    first += (first.to(tl.float32) < low).to(tl.int32)
    return first, last, is_near & (first <= last)


@kernel
def project_and_cull(rows, n, view, width, height, splats, ranges, pairs, BLOCK: tl.constexpr):
    """Compute the splat of each Gaussian, one lane per Gaussian.

    Args:
        rows: Gaussians, [n, 16].
        n: Number of Gaussians.
        view: View, [18]; the module describes the layout.
        width: Width of the image, pixels.
        height: Height of the image, pixels.
        splats: Output, [n, 16]; the module describes the layout.
        ranges: Output, [n, 4]: first tile (x0, y0) and last tile (x1, y1) of the bounding box of
            the pixels with alpha >= 1/255.
        pairs: Output, [n]: number of tiles of the box; 0 if the Gaussian is not drawn.
        BLOCK: Number of lanes of a Triton program.
    """
    i = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_live = i < n
    mean, scale, q, opacity, color = load_row(rows, i, is_live)
    R0, R1, R2, t, lens, limits, filters = camera_of(view, width, height)
    p = to_camera(mean, R0, R1, R2, t)
    du, dv, _inverse_z, x, y, _perspective = jacobian(p, R0, R1, R2, lens, limits)
    a0, a1, a2 = principal_axes(q, (exp(scale[0]), exp(scale[1]), exp(scale[2])))
    along_u = (dot(du, a0), dot(du, a1), dot(du, a2))
    along_v = (dot(dv, a0), dot(dv, a1), dot(dv, a2))
    low_pass, box = filters
    uu, uv, vv = image_covariance(along_u, along_v, low_pass)
    determinant = uu * vv - uv * uv
    per_log2 = tl.div_rn(-0.5 * LOG2_E, determinant)
    # Averaging over the wider pixels of a binned image lowers the peak of the splat. Without
    # binning, the box is 0 and both logarithms are equal.
    narrow = (uu - box) * (vv - box) - uv * uv
    log2_opacity = 0.0 - log2(1.0 + exp(0.0 - opacity))
    log2_opacity = log2_opacity + (log2(narrow) - log2(determinant)) * 0.5
    # Largest q = d' S^-1 d at which alpha >= 1/255.
    reach = (log2_opacity - LOG2_MIN_ALPHA) * (2.0 / LOG2_E)
    u, v = x * lens[0] + lens[2], y * lens[1] + lens[3]

    # NaN and infinity times zero are NaN, which fails every comparison.
    total = mean[0] + mean[1] + mean[2] + scale[0] + scale[1] + scale[2] + q[0] + q[1] + q[2]
    total = total + q[3] + opacity + color[0] + color[1] + color[2]
    is_drawn = is_live & (p[2] >= NEAR) & (reach >= 0.0) & (total * 0.0 >= 0.0)
    # A covariance of NaN, such as that of a quaternion of zeros, makes the radii NaN.
    left, right, is_across = pixels_within(u, tl.sqrt_rn(reach * uu), width)
    top, bottom, is_down = pixels_within(v, tl.sqrt_rn(reach * vv), height)
    is_drawn = is_drawn & is_across & is_down
    x0, x1 = tl.where(is_drawn, left, 0) // TILE, tl.where(is_drawn, right, 0) // TILE
    y0, y1 = tl.where(is_drawn, top, 0) // TILE, tl.where(is_drawn, bottom, 0) // TILE

    out = splats + i.to(tl.int64) * ROW
    tl.store(out, u, is_live)
    tl.store(out + 1, v, is_live)
    tl.store(out + 2, vv * per_log2, is_live)
    tl.store(out + 3, uv * per_log2 * -2.0, is_live)
    tl.store(out + 4, uu * per_log2, is_live)
    tl.store(out + 5, log2_opacity, is_live)
    tl.store(out + 6, tl.div_rn(uv, vv), is_live)
    tl.store(out + 7, tl.div_rn(uv, uu), is_live)
    tl.store(out + 8, color[0], is_live)
    tl.store(out + 9, color[1], is_live)
    tl.store(out + 10, color[2], is_live)
    tl.store(out + 11, p[2], is_live)
    tl.store(ranges + i * 4, x0, is_live)
    tl.store(ranges + i * 4 + 1, y0, is_live)
    tl.store(ranges + i * 4 + 2, x1, is_live)
    tl.store(ranges + i * 4 + 3, y1, is_live)
    tl.store(pairs + i, tl.where(is_drawn, (x1 - x0 + 1) * (y1 - y0 + 1), 0), is_live)


@kernel
def depth_keys(splats, visible, n, keys, BLOCK: tl.constexpr):
    """Write an integer sort key for each visible splat; the keys sort like the depths.

    Args:
        splats: Splats, [N, 16]; the module describes the layout.
        visible: Indices of the drawn splats, [n].
        n: Number of drawn splats.
        keys: Output, [n] int32: the bits of the float32 depth. These integers sort like the depths,
            because depths are positive.
        BLOCK: Number of lanes of a Triton program.
    """
    lane = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_live = lane < n
    i = tl.load(visible + lane, is_live, 0)
    z = tl.load(splats + i.to(tl.int64) * ROW + 11, is_live, 0.0)
    tl.store(keys + lane, z.to(tl.int32, bitcast=True), is_live)


@triton.jit
def exponent_at(dx, dy, a, b, c):
    return dx * (dx * a + dy * b) + dy * dy * c


@kernel
def list_pairs(
    splats, ranges, owners, firsts, n_pairs, columns, tiles, reached, BLOCK: tl.constexpr
):
    """Compute the tile of each pair, and the blocks of 4x4 pixels that its splat reaches.

    Args:
        splats: Splats, [N, 16]; the module describes the layout.
        ranges: First tile (x0, y0) and last tile (x1, y1) of each splat, [N, 4].
        owners: Index of the splat of each pair, [n_pairs]. The pairs of a splat are contiguous and
            follow its tiles row by row.
        firsts: Index of the first pair of each splat, [N].
        n_pairs: Number of pairs of a splat and a tile.
        columns: Number of tiles in a row of the image.
        tiles: Output, [n_pairs]: number of the tile, row by row.
        reached: Output, [n_pairs]: bit i is set if the ellipse alpha >= 1/255 reaches block i of
            the tile; blocks are numbered row by row.
        BLOCK: Number of lanes of a Triton program.
    """
    pair = tl.program_id(0) * BLOCK + tl.arange(0, BLOCK)
    is_live = pair < n_pairs
    s = tl.load(owners + pair, is_live, 0)
    x0 = tl.load(ranges + s * 4, is_live, 0)
    y0 = tl.load(ranges + s * 4 + 1, is_live, 0)
    across = tl.load(ranges + s * 4 + 2, is_live, 0) - x0 + 1
    k = tl.where(is_live, pair - tl.load(firsts + s, is_live, 0), 0)
    tile_x, tile_y = x0 + k % across, y0 + k // across
    tl.store(tiles + pair, tile_y * columns + tile_x, is_live)

    at = splats + s.to(tl.int64) * ROW
    u, v = tl.load(at, is_live, 0.0), tl.load(at + 1, is_live, 0.0)
    a, b = tl.load(at + 2, is_live, 0.0), tl.load(at + 3, is_live, 0.0)
    c = tl.load(at + 4, is_live, 0.0)
    # The margin of 1e-3 ensures that rounding drops no pixel that the blending would count.
    least = LOG2_MIN_ALPHA - tl.load(at + 5, is_live, 0.0) - 1e-3
    x_slope, y_slope = tl.load(at + 6, is_live, 0.0), tl.load(at + 7, is_live, 0.0)
    bits = tl.zeros([BLOCK], tl.int32)
    for block in tl.static_range(16):
        left = (tile_x * TILE).to(tl.float32) - u + (block % 4 * 4)
        top = (tile_y * TILE).to(tl.float32) - v + (block // 4 * 4)
        # Alpha is largest on a ridge line, on one of the two sides nearest to the center.
        side_x, side_y = clamp(0.0, left, left + 3.0), clamp(0.0, top, top + 3.0)
        best_y = clamp(side_x * y_slope, top, top + 3.0)
        best_x = clamp(side_y * x_slope, left, left + 3.0)
        on_x = exponent_at(side_x, best_y, a, b, c)
        on_y = exponent_at(best_x, side_y, a, b, c)
        bits = bits | tl.where(tl.maximum(on_x, on_y) >= least, 1 << block, 0)
    tl.store(reached + pair, bits, is_live)
