// Projection of Gaussians in the map to splats in the image. The method is EWA splatting (Zwicker
// et al. 2001), with the low-pass filter and the clamped Jacobian of Kerbl et al. 2023 (sec. 4 and
// the published code). In a binned image, each splat is also averaged over the wider pixel. Its
// integral stays the same, so its peak is lower (Yu et al., "Mip-Splatting", 2024).
#pragma once
#include <algorithm>

#include "rasterize.hpp"
#include "transpose.hpp"

namespace ldo::LDO_ISA {

constexpr float kNearPlane = 0.05f;  // Meters.
constexpr float kLog2e = 1.44269504f;
constexpr float kLog2MinAlpha = -7.99435344f;  // log2(1 / 255); weaker contributions are dropped.

// log2 alpha(x, y) = a dx^2 + b dx dy + c dy^2 + log2_opacity, with dx = x - u, dy = y - v.
struct alignas(64) Splat {
  float u, v;
  float a, b, c;
  float log2_opacity;
  float x_slope, y_slope;  // Slopes of the ridge lines dx = x_slope dy and dy = y_slope dx.
  float color[3];
  float z;
};

// Tiles [x0, x1] x [y0, y1] that a splat may touch.
struct TileRange {
  uint16_t x0, y0, x1, y1;
  uint32_t first_pair;  // Position of the splat's first (splat, tile) pair in its piece.
};

inline uint32_t area(const TileRange& r) { return (r.x1 - r.x0 + 1) * (r.y1 - r.y0 + 1); }

// Transpose rows [0, count) to columns of sixteen; missing rows are zero.
inline void transpose_rows(const float* rows, int count, float (&columns)[kRowFloats][kLanes]) {
  Floats matrix[kLanes];
  for (int i = 0; i < kLanes; ++i)
    matrix[i] = i < count ? Floats::load(rows + i * kRowFloats) : Floats(0.0f);
  transpose(matrix);
  for (int j = 0; j < kRowFloats; ++j) matrix[j].store(columns[j]);
}

// Return the lanes whose fields are all finite. NaN and infinity times zero are NaN, and NaN fails
// every comparison.
inline Mask is_finite(const float (&columns)[kRowFloats][kLanes]) {
  Floats sum = 0.0f;
  for (int j = 0; j < kFields; ++j) sum = sum + Floats::load(columns[j]);
  return sum * 0.0f >= 0.0f;
}

struct Vector3 {
  Floats x, y, z;
};

inline Floats dot(const Vector3& a, const Vector3& b) { return a.x * b.x + a.y * b.y + a.z * b.z; }

struct Axes {  // Columns of a rotation, each scaled by a standard deviation.
  Vector3 axis[3];
};

inline Floats exp(Floats x) { return exp2(clamp(x * kLog2e, -126.0f, 126.0f)); }

inline Axes principal_axes(const float (&columns)[kRowFloats][kLanes]) {
  const auto column = [&](int j) { return Floats::load(columns[j]); };
  const Floats w = column(kQuat), x = column(kQuat + 1), y = column(kQuat + 2),
               z = column(kQuat + 3);
  const Floats s = Floats(2.0f) / (w * w + x * x + y * y + z * z);
  const Floats s0 = exp(column(kLogScale)), s1 = exp(column(kLogScale + 1)),
               s2 = exp(column(kLogScale + 2));
  const Floats sx = s * x, sy = s * y, sz = s * z, one = 1.0f;
  const Floats xx = sx * x, yy = sy * y, zz = sz * z, xy = sx * y, xz = sx * z, yz = sy * z,
               wx = sx * w, wy = sy * w, wz = sz * w;
  return {{{(one - yy - zz) * s0, (xy + wz) * s0, (xz - wy) * s0},
           {(xy - wz) * s1, (one - xx - zz) * s1, (yz + wx) * s1},
           {(xz + wy) * s2, (yz - wx) * s2, (one - xx - yy) * s2}}};
}

// Sixteen projected Gaussians: the values of a Splat, with one array per field.
struct SplatColumns {
  float u[kLanes], v[kLanes], a[kLanes], b[kLanes], c[kLanes], log2_opacity[kLanes];
  float x_slope[kLanes], y_slope[kLanes], z[kLanes];
  float x_radius[kLanes], y_radius[kLanes];  // Half size of the box where alpha >= 1/255.
  uint32_t drawn;  // Bit i is set if lane i is finite, beyond the near plane and strong enough.
};

// Projection of sixteen Gaussians at a time into a view.
struct Projection {
  explicit Projection(const View& view) : view(view) {
    const float margin_x = 0.15f * view.width / view.fx, margin_y = 0.15f * view.height / view.fy;
    min_x = -view.cx / view.fx - margin_x;
    max_x = (view.width - view.cx) / view.fx + margin_x;
    min_y = -view.cy / view.fy - margin_y;
    max_y = (view.height - view.cy) / view.fy + margin_y;
  }

  Vector3 to_camera(const Vector3& p) const {
    const float* T = view.T_camera_map;
    const auto row = [&](int i) {
      return p.x * T[4 * i] + p.y * T[4 * i + 1] + p.z * T[4 * i + 2] + T[4 * i + 3];
    };
    return {row(0), row(1), row(2)};
  }

  // Compute the rows of J R, the derivative of (u, v) with respect to a point of the map. The
  // viewing direction is clamped to an area slightly larger than the image, because the affine
  // model fails farther outside.
  void jacobian(Floats x, Floats y, Floats inverse_z, Vector3& du, Vector3& dv) const {
    const float* T = view.T_camera_map;
    const Floats ju = inverse_z * view.fx, jv = inverse_z * view.fy;
    const Floats ku = ju * clamp(x, min_x, max_x), kv = jv * clamp(y, min_y, max_y);
    du = {ju * T[0] - ku * T[8], ju * T[1] - ku * T[9], ju * T[2] - ku * T[10]};
    dv = {jv * T[4] - kv * T[8], jv * T[5] - kv * T[9], jv * T[6] - kv * T[10]};
  }

  void operator()(const float (&columns)[kRowFloats][kLanes], SplatColumns& out) const {
    const auto column = [&](int j) { return Floats::load(columns[j]); };
    const Vector3 p = to_camera({column(kMean), column(kMean + 1), column(kMean + 2)});
    const Floats inverse_z = Floats(1.0f) / max(p.z, kNearPlane);
    const Floats x = p.x * inverse_z, y = p.y * inverse_z;
    Vector3 du, dv;
    jacobian(x, y, inverse_z, du, dv);

    Floats uu = view.low_pass, uv = 0.0f, vv = view.low_pass;  // Image covariance, px^2.
    for (const Vector3& axis : principal_axes(columns).axis) {
      const Floats su = dot(du, axis), sv = dot(dv, axis);
      uu = uu + su * su;
      uv = uv + su * sv;
      vv = vv + sv * sv;
    }
    const Floats determinant = uu * vv - uv * uv;
    const Floats scale = Floats(-0.5f * kLog2e) / determinant;
    Floats log2_opacity = Floats(0.0f) - log2(Floats(1.0f) + exp(Floats(0.0f) - column(kOpacity)));
    if (view.box > 0.0f) {  // Averaging over the wider pixel lowers the peak of the splat.
      const Floats narrow = (uu - view.box) * (vv - view.box) - uv * uv;
      log2_opacity = log2_opacity + (log2(narrow) - log2(determinant)) * 0.5f;
    }
    // Largest q = d' C^-1 d at which alpha >= 1/255.
    const Floats reach = (log2_opacity - kLog2MinAlpha) * (2.0f / kLog2e);

    (x * view.fx + view.cx).store(out.u);
    (y * view.fy + view.cy).store(out.v);
    (vv * scale).store(out.a);
    (uv * scale * -2.0f).store(out.b);
    (uu * scale).store(out.c);
    log2_opacity.store(out.log2_opacity);
    (uv / vv).store(out.x_slope);
    (uv / uu).store(out.y_slope);
    p.z.store(out.z);
    sqrt(reach * uu).store(out.x_radius);
    sqrt(reach * vv).store(out.y_radius);
    out.drawn = bits((p.z >= kNearPlane) & (reach >= 0.0f) & is_finite(columns));
  }

  const View& view;
  float min_x, max_x, min_y, max_y;  // Limits of x / z and y / z.
};

// Find the first and last pixel of [0, size) within `radius` of `center`. Return false if there is
// no such pixel or if an argument is NaN.
inline bool pixels_within(float center, float radius, int size, int& first, int& last) {
  const float low = std::max(center - radius, 0.0f), high = std::min(center + radius, size - 1.0f);
  if (!(low <= high)) return false;
  last = static_cast<int>(high);
  first = static_cast<int>(low);
  if (static_cast<float>(first) < low) ++first;
  return first <= last;
}

inline bool tiles_of(const SplatColumns& s, int lane, const View& view, TileRange& out) {
  int x0, x1, y0, y1;
  if (!pixels_within(s.u[lane], s.x_radius[lane], view.width, x0, x1)) return false;
  if (!pixels_within(s.v[lane], s.y_radius[lane], view.height, y0, y1)) return false;
  const auto tile = [](int pixel) { return static_cast<uint16_t>(pixel / kTile); };
  out = {tile(x0), tile(y0), tile(x1), tile(y1), 0};
  return true;
}

}  // namespace ldo::LDO_ISA
