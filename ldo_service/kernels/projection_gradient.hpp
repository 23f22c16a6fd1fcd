// Derivative of the projection. It converts the gradient sums of a splat over its pixels to
// derivatives by the row of the Gaussian and by the camera pose.
#pragma once
#include "blend_gradient.hpp"

namespace ldo::LDO_ISA {

inline Vector3 operator*(const Vector3& a, Floats s) { return {a.x * s, a.y * s, a.z * s}; }
inline Vector3 operator+(const Vector3& a, const Vector3& b) {
  return {a.x + b.x, a.y + b.y, a.z + b.z};
}
inline Vector3 operator-(const Vector3& a, const Vector3& b) {
  return {a.x - b.x, a.y - b.y, a.z - b.z};
}
inline Vector3 cross(const Vector3& a, const Vector3& b) {
  return {a.y * b.z - a.z * b.y, a.z * b.x - a.x * b.z, a.x * b.y - a.y * b.x};
}

struct PoseSums {  // Derivative by xi of T_map_camera exp(xi), lane by lane.
  Vector3 rotation{0.0f, 0.0f, 0.0f}, translation{0.0f, 0.0f, 0.0f};
};

struct ProjectionGradient {
  ProjectionGradient(const View& view, NeedlePenalty penalty)
      : projection(view),
        per_weight(penalty.weight / (static_cast<float>(view.width) * view.height)),
        log_ratio(penalty.log_ratio) {}

  // Convert the sums of sixteen Gaussians, one per lane, to the derivatives of their fields.
  void operator()(const float (&columns)[kRowFloats][kLanes], const Floats (&sums)[kLanes],
                  Floats (&out)[kLanes], PoseSums& pose) const {
    const auto column = [&](int j) { return Floats::load(columns[j]); };
    const Vector3 p = projection.to_camera({column(kMean), column(kMean + 1), column(kMean + 2)});
    const Floats inverse_z = Floats(1.0f) / max(p.z, kNearPlane);
    const Floats x = p.x * inverse_z, y = p.y * inverse_z;
    Vector3 du, dv;
    projection.jacobian(x, y, inverse_z, du, dv);
    const Axes axes = principal_axes(columns);

    // Image covariance S and its inverse K.
    const View& view = projection.view;
    Floats uu = view.low_pass, uv = 0.0f, vv = view.low_pass, along_u[3], along_v[3];
    for (int k = 0; k < 3; ++k) {
      along_u[k] = dot(du, axes.axis[k]);
      along_v[k] = dot(dv, axes.axis[k]);
      uu = uu + along_u[k] * along_u[k];
      uv = uv + along_u[k] * along_v[k];
      vv = vv + along_v[k] * along_v[k];
    }
    const Floats scale = Floats(1.0f) / (uu * vv - uv * uv);
    const Floats Kuu = vv * scale, Kuv = Floats(0.0f) - uv * scale, Kvv = uu * scale;

    // ln alpha = ln o - d' K d / 2:  dL/dmean = K sum(v d),  dL/dS = K sum(v d d') K / 2
    const Floats g_u = Kuu * sums[kVx] + Kuv * sums[kVy], g_v = Kuv * sums[kVx] + Kvv * sums[kVy];
    const Floats n_uu = Kuu * sums[kVxx] + Kuv * sums[kVxy],
                 n_uv = Kuu * sums[kVxy] + Kuv * sums[kVyy],
                 n_vu = Kuv * sums[kVxx] + Kvv * sums[kVxy],
                 n_vv = Kuv * sums[kVxy] + Kvv * sums[kVyy];
    Floats two_S_uu = n_uu * Kuu + n_uv * Kuv, two_S_uv = n_uu * Kuv + n_uv * Kvv,
           two_S_vv = n_vu * Kuv + n_vv * Kvv;
    // Binning adds the term ln(|S - box I| / |S|) / 2 to ln alpha.
    if (view.box > 0.0f) {
      const Floats nn = uu - view.box, mm = vv - view.box;
      const Floats narrow = sums[kV] / (nn * mm - uv * uv);
      two_S_uu = two_S_uu + mm * narrow - sums[kV] * Kuu;
      two_S_uv = two_S_uv - uv * narrow - sums[kV] * Kuv;
      two_S_vv = two_S_vv + nn * narrow - sums[kV] * Kvv;
    }

    // S = low pass + sum over axes of (du.a, dv.a)(du.a, dv.a)'
    Vector3 g_du{0.0f, 0.0f, 0.0f}, g_dv = g_du, g_axis[3];
    for (int k = 0; k < 3; ++k) {
      const Floats a = two_S_uu * along_u[k] + two_S_uv * along_v[k],
                   b = two_S_uv * along_u[k] + two_S_vv * along_v[k];
      g_du = g_du + axes.axis[k] * a;
      g_dv = g_dv + axes.axis[k] * b;
      g_axis[k] = du * a + dv * b;
      out[kLogScale + k] = a * along_u[k] + b * along_v[k];
    }
    rotation_gradient(columns, g_axis, out + kQuat);
    penalise_needles(columns, sums[kWeightSum], out + kLogScale);

    // Point in the camera frame, through the Jacobian and the perspective division.
    const Vector3 g_row_u = to_camera_axes(g_du), g_row_v = to_camera_axes(g_dv);
    const Floats ju = inverse_z * view.fx, jv = inverse_z * view.fy;
    const Floats ku = ju * clamp(x, projection.min_x, projection.max_x),
                 kv = jv * clamp(y, projection.min_y, projection.max_y);
    const Floats ku_moves = inside(x, projection.min_x, projection.max_x),
                 kv_moves = inside(y, projection.min_y, projection.max_y);
    Vector3 g;
    g.x = ju * (g_u - ku_moves * inverse_z * g_row_u.z);
    g.y = jv * (g_v - kv_moves * inverse_z * g_row_v.z);
    g.z = sums[kWeightDepth] -
          inverse_z * (g_u * ju * p.x + g_v * jv * p.y + ju * g_row_u.x + jv * g_row_v.y -
                       (ku_moves + 1.0f) * ku * g_row_u.z - (kv_moves + 1.0f) * kv * g_row_v.z);
    const Vector3 g_mean = to_map_axes(g);
    out[kMean] = g_mean.x;
    out[kMean + 1] = g_mean.y;
    out[kMean + 2] = g_mean.z;
    out[kOpacity] = sums[kV] / (Floats(1.0f) + exp(column(kOpacity)));
    for (int c = 0; c < 3; ++c) out[kColor + c] = sums[kWeightRed + c];
    out[kWeight] = sums[kWeightSum];
    out[kWeight + 1] = 0.0f;

    // T_camera_map' = exp(-xi) T_camera_map rotates and moves both the point and the rows of J R.
    const Vector3 row_u{ju, 0.0f, Floats(0.0f) - ku}, row_v{0.0f, jv, Floats(0.0f) - kv};
    pose.rotation = pose.rotation - cross(p, g) - cross(g_row_u, row_u) - cross(g_row_v, row_v);
    pose.translation = pose.translation - g;
  }

 private:
  static Floats inside(Floats x, float low, float high) {
    return select((x >= low) & (Floats(high) >= x), 1.0f, 0.0f);
  }
  Vector3 to_camera_axes(const Vector3& v) const {
    const float* T = projection.view.T_camera_map;
    const auto row = [&](int i) {
      return v.x * T[4 * i] + v.y * T[4 * i + 1] + v.z * T[4 * i + 2];
    };
    return {row(0), row(1), row(2)};
  }
  Vector3 to_map_axes(const Vector3& v) const {
    const float* T = projection.view.T_camera_map;
    const auto column = [&](int j) { return v.x * T[j] + v.y * T[4 + j] + v.z * T[8 + j]; };
    return {column(0), column(1), column(2)};
  }

  // Convert derivatives by the scaled axes to derivatives by the quaternion (w, x, y, z), of any
  // length.
  static void rotation_gradient(const float (&columns)[kRowFloats][kLanes], Vector3 (&g_axis)[3],
                                Floats* out) {
    const auto column = [&](int j) { return Floats::load(columns[j]); };
    Floats w = column(kQuat), x = column(kQuat + 1), y = column(kQuat + 2), z = column(kQuat + 3);
    const Floats shorten = Floats(1.0f) / sqrt(w * w + x * x + y * y + z * z);
    w = w * shorten, x = x * shorten, y = y * shorten, z = z * shorten;
    for (int k = 0; k < 3; ++k) g_axis[k] = g_axis[k] * exp(column(kLogScale + k));
    const auto& [c0, c1, c2] = g_axis;  // dL/dR by columns.
    const Floats g_w = x * (c1.z - c2.y) + y * (c2.x - c0.z) + z * (c0.y - c1.x);
    const Floats g_x =
        w * (c1.z - c2.y) + y * (c1.x + c0.y) + z * (c2.x + c0.z) - x * 2.0f * (c1.y + c2.z);
    const Floats g_y =
        w * (c2.x - c0.z) + x * (c1.x + c0.y) + z * (c2.y + c1.z) - y * 2.0f * (c0.x + c2.z);
    const Floats g_z =
        w * (c0.y - c1.x) + x * (c2.x + c0.z) + y * (c2.y + c1.z) - z * 2.0f * (c0.x + c1.y);
    // The length of the quaternion has no effect, so the radial part of the gradient is removed.
    const Floats radial = w * g_w + x * g_x + y * g_y + z * g_z;
    const Floats twice = shorten * 2.0f;
    out[0] = (g_w - w * radial) * twice;
    out[1] = (g_x - x * radial) * twice;
    out[2] = (g_y - y * radial) * twice;
    out[3] = (g_z - z * radial) * twice;
  }

  void penalise_needles(const float (&columns)[kRowFloats][kLanes], Floats weight,
                        Floats* out) const {
    const auto log_scale = [&](int k) { return Floats::load(columns[kLogScale + k]); };
    const Floats longest = max(log_scale(0), max(log_scale(1), log_scale(2)));
    const Floats middle =
        max(min(log_scale(0), log_scale(1)), min(max(log_scale(0), log_scale(1)), log_scale(2)));
    const Floats push = select(longest - middle >= log_ratio, weight * per_weight, 0.0f);
    for (int k = 0; k < 3; ++k) {
      const Floats is_longest = select(log_scale(k) >= longest, push, 0.0f);
      const Floats is_middle = select(equal(log_scale(k), middle), push, 0.0f);
      out[k] = out[k] + is_longest - is_middle;
    }
  }
  static Mask equal(Floats a, Floats b) { return (a >= b) & (b >= a); }

  Projection projection;
  float per_weight, log_ratio;
};

}  // namespace ldo::LDO_ISA
