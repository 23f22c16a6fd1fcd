// Assignment of Gaussians to the regions of an image.
#pragma once
#include <cmath>
#include <limits>
#include <vector>

#include "labels.hpp"
#include "projection.hpp"

namespace ldo::LDO_ISA {

// Boxes of two standard deviations around sixteen splats, clipped to the image.
struct SplatBoxes {
  float x0[kLanes], y0[kLanes], x1[kLanes], y1[kLanes], z[kLanes];
  float u[kLanes], v[kLanes];  // Pixel of the center.
  uint32_t expected;  // Bit i is set if lane i is in the image and on the surface measured there.
};

// Projection of Gaussians to the boxes of their splats.
class SplatBoxer {
 public:
  SplatBoxer(const View& view, const float* depth_m, const AssignmentRule& rule)
      : view_(view), project_(view_), depth_m_(depth_m), rule_(rule) {}

  // Compute the boxes of the rows `indices` [count].
  void operator()(const float* rows, const uint32_t* indices, int count, SplatBoxes& out) const {
    alignas(64) float columns[kRowFloats][kLanes];
    gather(rows, indices, count, columns);
    const auto column = [&](int j) { return Floats::load(columns[j]); };
    const Vector3 p = project_.to_camera({column(kMean), column(kMean + 1), column(kMean + 2)});
    const Floats inverse_z = Floats(1.0f) / max(p.z, kNearPlane);
    const Floats x = p.x * inverse_z, y = p.y * inverse_z;
    Vector3 du, dv;
    project_.jacobian(x, y, inverse_z, du, dv);
    Floats uu = view_.low_pass, vv = view_.low_pass;
    for (const Vector3& axis : principal_axes(columns).axis) {
      const Floats su = dot(du, axis), sv = dot(dv, axis);
      uu = uu + su * su;
      vv = vv + sv * sv;
    }
    const Floats u = x * view_.fx + view_.cx, v = y * view_.fy + view_.cy;
    const Floats half_x = sqrt(uu) * 2.0f, half_y = sqrt(vv) * 2.0f;
    const float right = view_.width - 0.5f, bottom = view_.height - 0.5f;
    clamp(u - half_x, -0.5f, right).store(out.x0);
    clamp(u + half_x, -0.5f, right).store(out.x1);
    clamp(v - half_y, -0.5f, bottom).store(out.y0);
    clamp(v + half_y, -0.5f, bottom).store(out.y1);
    p.z.store(out.z);
    const Mask inside = (u >= -0.5f) & (u < right) & (v >= -0.5f) & (v < bottom);
    u.store(out.u);
    v.store(out.v);
    const Mask drawn = inside & (p.z >= kNearPlane) & is_finite(columns);
    const Floats measured = depth_at(select(drawn, u, 0.0f), select(drawn, v, 0.0f));
    const Mask on_surface = (Floats(0.0f) < measured) & (p.z - measured < rule_.max_depth_gap_m) &
                            (measured - p.z < rule_.max_front_gap_m);
    out.expected = bits(drawn & on_surface) & ((1u << count) - 1);
  }

 private:
  static void gather(const float* rows, const uint32_t* indices, int count,
                     float (&columns)[kRowFloats][kLanes]) {
    Floats matrix[kLanes];
    for (int i = 0; i < kLanes; ++i)
      matrix[i] = i < count ? Floats::load(rows + static_cast<int64_t>(indices[i]) * kRowFloats)
                            : Floats(0.0f);
    transpose(matrix);
    for (int j = 0; j < kRowFloats; ++j) matrix[j].store(columns[j]);
  }

  // Return the depth at the pixels that contain these points. Just below the end of the image,
  // u + 0.5 can round up to the width. The index is therefore limited to the last pixel.
  Floats depth_at(Floats u, Floats v) const {
    alignas(64) float column[kLanes], row[kLanes], depth_m[kLanes];
    min(u + 0.5f, view_.width - 1.0f).store(column);
    min(v + 0.5f, view_.height - 1.0f).store(row);
    for (int i = 0; i < kLanes; ++i)
      depth_m[i] =
          depth_m_[static_cast<int64_t>(row[i]) * view_.width + static_cast<int64_t>(column[i])];
    return Floats::load(depth_m);
  }

  const View view_;
  const Projection project_;
  const float* const depth_m_;
  const AssignmentRule rule_;
};

// Return the area of a region's mask left of x and above y, in pixels with fractions. Bilinear
// interpolation between the entries of the summed-area table is exact, because the mask is constant
// in each pixel.
inline double sum_before(const int32_t* sums, int width, int height, double x, double y) {
  x = std::min(std::max(x, 0.0), static_cast<double>(width));
  y = std::min(std::max(y, 0.0), static_cast<double>(height));
  const int column = std::min(static_cast<int>(x), width - 1);
  const int row = std::min(static_cast<int>(y), height - 1);
  const double fx = x - column, fy = y - row;
  const int32_t* above = sums + static_cast<int64_t>(row) * (width + 1) + column;
  const int32_t* below = above + width + 1;
  return (above[0] * (1 - fx) + above[1] * fx) * (1 - fy) +
         (below[0] * (1 - fx) + below[1] * fx) * fy;
}

// Region of an image: a box, or the mask in a rectangle.
class Region {
 public:
  Region(const Regions& regions, int64_t j)
      : score(regions.scores[j]), rect_(regions.rects + 4 * j), sums_(nullptr) {
    for (int k = 0; k < 4; ++k) bound[k] = regions.boxes[4 * j + k];
    area_ = static_cast<double>(bound[2] - bound[0]) * (bound[3] - bound[1]);
    if (rect_[2] > 0) {
      sums_ = regions.sums + regions.offsets[j];
      area_ = sums_[static_cast<int64_t>(rect_[2] + 1) * (rect_[3] + 1) - 1];
      for (int k = 0; k < 2; ++k) bound[k] = static_cast<float>(rect_[k]) - 0.5f;
      for (int k = 0; k < 2; ++k) bound[2 + k] = bound[k] + static_cast<float>(rect_[2 + k]);
    }
  }

  // Return the area that the splat of a lane and the region share, divided by the area of the
  // splat. If `by_iou` is set, divide by the area of their union instead.
  float overlap(const SplatBoxes& s, int i, bool by_iou) const {
    const double splat = static_cast<double>(s.x1[i] - s.x0[i]) * (s.y1[i] - s.y0[i]);
    const double shared = sums_ == nullptr ? within_box(s, i) : within_mask(s, i);
    return static_cast<float>(shared / (by_iou ? area_ + splat - shared : splat));
  }

  // Return whether the region contains the center of the splat.
  bool holds(const SplatBoxes& s, int i) const {
    const float u = s.u[i], v = s.v[i];
    if (!(u >= bound[0] && u < bound[2] && v >= bound[1] && v < bound[3])) return false;
    if (sums_ == nullptr) return true;
    const int64_t stride = rect_[2] + 1;
    const int32_t* corner =
        sums_ + static_cast<int64_t>(v - bound[1]) * stride + static_cast<int64_t>(u - bound[0]);
    return corner[stride + 1] - corner[stride] - corner[1] + corner[0] > 0;
  }

  const float score;
  float bound[4];

 private:
  double within_box(const SplatBoxes& s, int i) const {
    const double width = std::min(s.x1[i], bound[2]) - std::max(s.x0[i], bound[0]);
    const double height = std::min(s.y1[i], bound[3]) - std::max(s.y0[i], bound[1]);
    return std::max(width, 0.0) * std::max(height, 0.0);
  }
  double within_mask(const SplatBoxes& s, int i) const {
    const auto before = [&](float x, float y) {
      return sum_before(sums_, rect_[2], rect_[3], static_cast<double>(x) - bound[0],
                        static_cast<double>(y) - bound[1]);
    };
    return before(s.x1[i], s.y1[i]) - before(s.x0[i], s.y1[i]) - before(s.x1[i], s.y0[i]) +
           before(s.x0[i], s.y0[i]);
  }

  const int32_t* const rect_;
  const int32_t* sums_;
  double area_;
};

// Regions of the image, with a search for those that sixteen splats may overlap.
class Candidates {
 public:
  explicit Candidates(const Regions& regions) {
    const int64_t padded = (regions.m + kLanes - 1) / kLanes * kLanes;
    // The NaN bounds that pad the last vector overlap no splat.
    for (auto& bound : bounds_) bound.assign(padded, std::numeric_limits<float>::quiet_NaN());
    for (int64_t j = 0; j < regions.m; ++j) {
      regions_.emplace_back(regions, j);
      for (int k = 0; k < 4; ++k) bounds_[k][j] = regions_[j].bound[k];
    }
  }

  // Call f(number, region), in order, for the regions that overlap the box around all splats.
  template <class F>
  void each_near(const SplatBoxes& s, F f) const {
    if (s.expected == 0) return;
    const Floats x0 = lowest(Floats::load(s.x0)), y0 = lowest(Floats::load(s.y0)),
                 x1 = highest(Floats::load(s.x1)), y1 = highest(Floats::load(s.y1));
    for (size_t first = 0; first < bounds_[0].size(); first += kLanes) {
      const auto bound = [&](int k) { return Floats::load(bounds_[k].data() + first); };
      const Mask meet = (x0 < bound(2)) & (bound(0) < x1) & (y0 < bound(3)) & (bound(1) < y1);
      for (uint32_t rest = bits(meet); rest != 0; rest &= rest - 1) {
        const size_t j = first + __builtin_ctz(rest);
        f(static_cast<int32_t>(j), regions_[j]);
      }
    }
  }

 private:
  std::vector<Region> regions_;
  std::vector<float> bounds_[4];  // bounds_[k][j] is bound[k] of region j.
};

// Selection of the region with the largest reliability for each of sixteen splats. Reliability is
// overlap times score; if several are equal, the first region is selected. The constructor and
// `enter` write the selected region and its overlap for the first `count` splats.
class Contest {
 public:
  Contest(uint32_t expected, int count, int32_t* region, float* overlap)
      : region_(region), overlap_(overlap) {
    for (int i = 0; i < count; ++i) region_[i] = expected >> i & 1 ? kUnmatched : kUnexpected;
    std::fill_n(overlap_, count, 0.0f);
  }

  void enter(int32_t j, const Region& candidate, const SplatBoxes& s, const AssignmentRule& rule) {
    const Mask meet = (Floats::load(s.x0) < candidate.bound[2]) &
                      (Floats(candidate.bound[0]) < Floats::load(s.x1)) &
                      (Floats::load(s.y0) < candidate.bound[3]) &
                      (Floats(candidate.bound[1]) < Floats::load(s.y1));
    for (uint32_t rest = bits(meet) & s.expected; rest != 0; rest &= rest - 1) {
      const int i = __builtin_ctz(rest);
      if (!rule.by_iou && !candidate.holds(s, i)) continue;
      const float shared = candidate.overlap(s, i, rule.by_iou);
      const float reliability = shared * candidate.score;
      if (!(shared > rule.min_overlap && reliability > best_[i])) continue;
      best_[i] = reliability;
      region_[i] = j;
      overlap_[i] = shared;
    }
  }

 private:
  int32_t* const region_;
  float* const overlap_;
  float best_[kLanes] = {};
};

}  // namespace ldo::LDO_ISA
