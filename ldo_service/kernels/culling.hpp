// Culling of blocks of consecutive rows. A block is skipped only if the projection would draw none
// of its rows, so that the images stay bitwise equal.
#pragma once
#include <cmath>

#include "buffer.hpp"
#include "projection.hpp"

namespace ldo::LDO_ISA {

// Minimum squared norm of a quaternion; a shorter one gives no accurate rotation.
constexpr float kMinNorm2 = 1e-30f;

// Accumulator of the bound of some rows, sixteen rows at a time.
class Measure {
 public:
  void add(const float (&columns)[kRowFloats][kLanes], int count) {
    const auto column = [&](int j) { return Floats::load(columns[j]); };
    const Mask counts = is_finite(columns) & (Floats::ramp() < static_cast<float>(count));
    for (int k = 0; k < 3; ++k) {
      low_[k] = min(low_[k], select(counts, column(kMean + k), kFar));
      high_[k] = max(high_[k], select(counts, column(kMean + k), -kFar));
    }
    Floats norm2 = 0.0f;
    for (int j = kQuat; j < kQuat + 4; ++j) norm2 = norm2 + column(j) * column(j);
    const Floats longest =
        max(column(kLogScale), max(column(kLogScale + 1), column(kLogScale + 2)));
    log_sigma_ = max(log_sigma_, select(counts, select(norm2 >= kMinNorm2, longest, kFar), -kFar));
  }

  BlockBound bound() const {
    BlockBound out;
    for (int k = 0; k < 3; ++k) {
      out.low[k] = -largest(Floats(0.0f) - low_[k]);
      out.high[k] = largest(high_[k]);
    }
    out.sigma = std::exp(largest(log_sigma_));
    out.is_known = true;
    return out;
  }

 private:
  static constexpr float kFar = 1e30f;
  static float largest(Floats x) {
    alignas(64) float lanes[kLanes];
    x.store(lanes);
    return *std::max_element(lanes, lanes + kLanes);
  }
  Floats low_[3] = {kFar, kFar, kFar}, high_[3] = {-kFar, -kFar, -kFar};
  Floats log_sigma_ = -kFar;
};

// Half spaces n . mean + d + s sigma >= 0 in the map frame. Every Gaussian that is drawn fulfills
// all of these conditions.
//
// The box of a splat extends by r = sqrt(2 ln(255 o) S_uu) on both sides of u = fx x / z + cx. Its
// variance is S_uu = low_pass + |du . axes|^2 <= 0.3 + (fx / z)^2 m^2 sigma^2. Here m^2 bounds
// |row_0 - clamp(x / z) row_2|^2 of T_camera_map. Hence r z <= 3.33 (0.55 z + fx m sigma). The
// conditions u + r >= 0 and u - r <= width - 1, times z > 0, are therefore linear in the mean. The
// same holds for v.
class ViewFrustum {
 public:
  explicit ViewFrustum(const View& view) {
    const Projection projection(view);
    const auto largest = [](float a, float b) { return std::max(std::abs(a), std::abs(b)); };
    add_sides(view, 0, view.fx, view.cx, view.width, largest(projection.min_x, projection.max_x));
    add_sides(view, 1, view.fy, view.cy, view.height, largest(projection.min_y, projection.max_y));
    add(view, 2, 0.0f, 1.0f, 0.0f);
    sides_[kSides - 1].offset -= kNearPlane;
  }

  // Return whether no Gaussian of a block is drawn. The answer is conservative: false is always
  // safe, and NaN gives false.
  bool misses(const BlockBound& bound) const {
    for (const Side& side : sides_) {
      float value = side.offset + side.per_sigma * bound.sigma;
      for (int k = 0; k < 3; ++k) {
        value += std::max(side.normal[k] * bound.low[k], side.normal[k] * bound.high[k]);
        value += side.slack[k] * std::max(-bound.low[k], bound.high[k]);
      }
      if (value < 0.0f) return true;
    }
    return false;
  }

 private:
  static constexpr int kSides = 5;
  static constexpr float kReachSigmas = 3.34f;     // More than sqrt(2 ln 255).
  static constexpr float kLowPassSigma = 0.5478f;  // More than the root of any low_pass.
  // Tolerance as a fraction of each term, for the rounding errors of the projection.
  static constexpr float kSlack = 1e-4f;
  struct Side {
    float normal[3], slack[3], offset, per_sigma;
  };

  // Add the two side planes of the frustum that limit image axis `row`: 0 for u, 1 for v.
  void add_sides(const View& view, int row, float focal, float center, int size, float tangent) {
    const float *a = view.T_camera_map + 4 * row, *b = view.T_camera_map + 8;
    const auto dot = [](const float* p, const float* q) {
      return p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    };
    const float m2 = dot(a, a) + tangent * (tangent * dot(b, b) + 2.0f * std::abs(dot(a, b)));
    const float per_sigma = kReachSigmas * focal * std::sqrt(m2);
    const float margin = kReachSigmas * kLowPassSigma;
    add(view, row, focal, center + margin, per_sigma);
    add(view, row, -focal, static_cast<float>(size - 1) - center + margin, per_sigma);
  }

  // Add the side by_row p[row] + by_z p.z + per_sigma sigma >= 0 for points p of the camera frame.
  void add(const View& view, int row, float by_row, float by_z, float per_sigma) {
    const float *a = view.T_camera_map + 4 * row, *b = view.T_camera_map + 8;
    Side& side = sides_[count_++];
    const auto size = [&](int k) { return std::abs(by_row * a[k]) + std::abs(by_z * b[k]); };
    for (int k = 0; k < 3; ++k) {
      side.normal[k] = by_row * a[k] + by_z * b[k];
      side.slack[k] = kSlack * size(k);
    }
    side.offset = by_row * a[3] + by_z * b[3] + kSlack * size(3);
    side.per_sigma = per_sigma;
  }

  Side sides_[kSides];
  int count_ = 0;
};

inline void list_blocks_in_view(const Gaussians& gaussians, const View& view,
                                Buffer<uint32_t>& out) {
  const int64_t blocks = (gaussians.n + kBlockRows - 1) / kBlockRows;
  const ViewFrustum frustum(view);
  out.resize(blocks);
  int64_t count = 0;
  for (int64_t block = 0; block < blocks; ++block) {
    const BlockBound* bound = gaussians.bounds == nullptr ? nullptr : &gaussians.bounds[block];
    if (bound != nullptr && bound->is_known && frustum.misses(*bound)) continue;
    out[count++] = static_cast<uint32_t>(block);
  }
  out.resize(count);
}

}  // namespace ldo::LDO_ISA
