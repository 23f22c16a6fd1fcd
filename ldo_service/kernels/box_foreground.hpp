// Foreground of a box: the object that fills its middle.
#pragma once
#include <cmath>
#include <limits>
#include <vector>

#include "components.hpp"
#include "foreground.hpp"
#include "inverse_depth.hpp"

namespace ldo::LDO_ISA {

// Minimum fraction of the pixels near the depth mode that a connected part of the object contains.
constexpr double kLeastShare = 0.1;

// Image of floats for a window, with a border of zeros.
class Plane {
 public:
  Plane(int width, int height)
      : stride_(padded(width)), values_(static_cast<size_t>(stride_) * (height + 2)) {
    std::fill_n(values_.data(), values_.size(), 0.0f);
  }
  float* row(int y) { return values_.data() + (y + 1) * stride_ + kLanes; }

 private:
  int64_t stride_;
  Buffer<float> values_;
};

// Mode of depths. The width of a bin is a fraction of the depth, and the count of each bin is
// smoothed with those of its neighbors.
class DepthMode {
 public:
  DepthMode(double bin_share, size_t most_pixels)
      : bin_share_(bin_share), bins_(most_pixels + kLanes) {}

  void add(const float* depth_m, int n) {
    const float per_log2 = static_cast<float>(kLn2 / bin_share_);
    for (int i = 0; i < n; i += kLanes) {
      const int count = std::min(kLanes, n - i);
      const Floats z = Floats::load_first(depth_m + i, count);
      alignas(64) float at[kLanes];
      (log2(max(z, std::numeric_limits<float>::min())) * per_log2).store(at);
      const uint32_t is_measured = bits((Floats(0.0f) < z) & (z < kInfinity));
      for (int k = 0; k < kLanes; ++k) {
        bins_[size_] = rounded_down(at[k]);
        size_ += is_measured >> k & 1;
      }
    }
  }

  // Return the mode in meters; 0 if no depth was added.
  double value() const {
    if (size_ == 0) return 0.0;
    const int *begin = bins_.data(), *end = begin + size_;
    const int low = *std::min_element(begin, end), high = *std::max_element(begin, end);
    std::vector<int64_t> counts(high - low + 3, 0);  // One more empty bin lies on each side.
    for (const int* bin = begin; bin < end; ++bin) ++counts[*bin - low + 1];
    int64_t most = 0;
    int best = 0;
    for (size_t k = 1; k + 1 < counts.size(); ++k) {
      const int64_t smoothed = counts[k - 1] + 2 * counts[k] + counts[k + 1];
      if (smoothed > most) most = smoothed, best = static_cast<int>(k) - 1 + low;
    }
    return std::exp((best + 0.5) * bin_share_);
  }

 private:
  static constexpr float kInfinity = std::numeric_limits<float>::infinity();
  static constexpr double kLn2 = 0.69314718055994531;

  static int rounded_down(float x) {
    const int towards_0 = static_cast<int>(x);
    return towards_0 - (x < static_cast<float>(towards_0));
  }

  const double bin_share_;
  Buffer<int> bins_;  // Bins of the measured depths.
  size_t size_ = 0;
};

class BoxForeground {
 public:
  BoxForeground(const DepthImage& image, double focal_px, const SurfaceLabels& found,
                const Window& window, const ForegroundRule& rule)
      : image_(image),
        focal_px_(focal_px),
        found_(found),
        window_(window),
        rule_(rule),
        belongs_(window.width, window.height),
        mask_(window.width, window.height) {}

  // Write `mask` [height, width] of the window, 0 or 1. Return false if a label has no entry in the
  // sizes of the labels.
  bool write(uint8_t* mask) {
    std::fill_n(mask, static_cast<int64_t>(window_.height) * window_.width, uint8_t{0});
    if (!find_mode()) return true;
    if (!find_what_belongs()) return false;
    if (!keep_what_hangs_together()) return true;
    for (int k = 0; k < rule_.grow_px; ++k) grow();
    for (int y = 0; y < window_.height; ++y)
      for (int x = 0; x < window_.width; ++x) *mask++ = mask_.row(y)[x] > 0.0f;
    return true;
  }

 private:
  int64_t at(int y) const {  // Index in the image of the first pixel of a window row.
    return static_cast<int64_t>(window_.row + y) * image_.width + window_.column;
  }
  // Return the number of pixels before the middle half of a side of the window; as many follow it.
  static int margin(int side) { return side / 4; }

  bool find_mode() {
    DepthMode mode(rule_.depth_bin, static_cast<size_t>(window_.width) * window_.height);
    const int left = margin(window_.width), right = window_.width - left;
    for (int y = margin(window_.height); y < window_.height - margin(window_.height); ++y)
      mode.add(image_.depth_m + at(y) + left, right - left);
    mode_m_ = mode.value();
    return mode_m_ > 0.0;
  }

  struct Run {  // Pixels of a row with equal label.
    int row, begin, end;
    int32_t label;
  };

  std::vector<Run> runs() const {
    std::vector<Run> out;
    for (int y = 0; y < window_.height; ++y) {
      const int32_t* labels = found_.labels + at(y);
      for (int begin = 0, end; begin < window_.width; begin = end) {
        for (end = begin + 1; end < window_.width && labels[end] == labels[begin];) ++end;
        out.push_back({y, begin, end, labels[begin]});
      }
    }
    return out;
  }

  // Copy the depths of pixels that may belong to the object. Such a pixel lies on an edge (label 0)
  // or on a surface that is mostly inside the box. Its depth differs from the mode by less than the
  // longer side of the box in meters, or by less than near_mode times the mode if that is more.
  // Return false if a label has no entry in the sizes of the labels.
  bool find_what_belongs() {
    const std::vector<Run> all = runs();
    std::vector<int64_t> inside(found_.count, 0);
    for (const Run& run : all) {
      if (run.label < 0 || run.label >= found_.count) return false;
      inside[run.label] += run.end - run.begin;
    }
    const double wide_m = std::max(window_.width, window_.height) * mode_m_ / focal_px_;
    const float mode_m = static_cast<float>(mode_m_),
                reach_m = static_cast<float>(std::max(wide_m, rule_.near_mode * mode_m_));
    for (const Run& run : all) {
      const bool is_inside = static_cast<double>(inside[run.label]) >=
                             rule_.min_inside * static_cast<double>(found_.sizes[run.label]);
      if (run.label != 0 && !is_inside) continue;
      const float* depth_m = image_.depth_m + at(run.row);
      float* belongs = belongs_.row(run.row);
      for (int x = run.begin; x < run.end; ++x) {
        const bool is_near = (depth_m[x] > 0.0f) & (std::fabs(depth_m[x] - mode_m) < reach_m);
        belongs[x] = is_near ? depth_m[x] : 0.0f;
      }
    }
    return true;
  }

  // Keep the connected parts without depth steps that hold at least a tenth of the seeds. Seeds are
  // the pixels in the middle of the window whose depth is near the mode. Return false if there are
  // no seeds.
  bool keep_what_hangs_together() {
    const Components parts(joined());
    std::vector<int64_t> seeds(parts.count() + 1, 0);
    int64_t all = 0;
    const int left = margin(window_.width), right = window_.width - left;
    for (int y = margin(window_.height); y < window_.height - margin(window_.height); ++y)
      parts.each_run(y, [&](const Components::Run& run) {
        const int64_t count = near_mode(y, std::max(run.begin, left), std::min(run.end, right));
        seeds[run.part] += count;
        all += count;
      });
    for (int y = 0; y < window_.height; ++y)
      parts.each_run(y, [&](const Components::Run& run) {
        const double share = static_cast<double>(seeds[run.part]) / static_cast<double>(all);
        if (share >= kLeastShare)
          std::copy(belongs_.row(y) + run.begin, belongs_.row(y) + run.end,
                    mask_.row(y) + run.begin);
      });
    return all > 0;
  }

  BitImage joined() {
    BitImage out(window_.width, window_.height);
    InverseDepth inverse(image_.depth_m + at(0), image_.width, window_.width, window_.height);
    for (int y = 0; y <= window_.height; ++y) {
      if (y < window_.height) inverse.load(y);
      if (y == 0) continue;
      const float* belongs = belongs_.row(y - 1);
      inverse.each_extreme(y - 1, [&](int i, Floats low, Floats high) {
        const Mask is_joined = low * rule_.max_ratio >= high;
        out.set(y - 1, i, bits((Floats(0.0f) < Floats::load(belongs + i)) & is_joined));
      });
    }
    return out;
  }

  int64_t near_mode(int y, int begin, int end) {
    const float* depth_m = belongs_.row(y);
    const float mode_m = static_cast<float>(mode_m_), near = static_cast<float>(rule_.near_mode);
    int count = 0;
    for (int x = begin; x < end; ++x) count += std::fabs(depth_m[x] / mode_m - 1.0f) < near;
    return count;
  }

  // Grow the mask by one pixel. A pixel of `belongs_` joins the mask if its depth is close to that
  // of its farthest neighbor in the mask.
  void grow() {
    Plane grown(window_.width, window_.height);
    const float near = static_cast<float>(rule_.near_mode);
    for (int y = 0; y < window_.height; ++y) {
      const float *above = mask_.row(y - 1), *here = mask_.row(y), *below = mask_.row(y + 1);
      each_vector(window_.width, [&](int i) {
        const auto largest = [i](const float* row) {
          return max(max(Floats::load(row + i - 1), Floats::load(row + i)),
                     Floats::load(row + i + 1));
        };
        const Floats beside = max(max(largest(above), largest(here)), largest(below));
        const Floats belongs = Floats::load(belongs_.row(y) + i), zero = 0.0f;
        const Mask joins =
            (zero < belongs) & (zero < beside) & (abs(belongs - beside) < beside * near);
        select(joins, belongs, Floats::load(here + i)).store(grown.row(y) + i);
      });
    }
    mask_ = std::move(grown);
  }

  const DepthImage& image_;
  const double focal_px_;
  const SurfaceLabels& found_;
  const Window window_;
  const ForegroundRule rule_;
  double mode_m_ = 0.0;
  Plane belongs_, mask_;  // Depths of the pixels that are selected, 0 elsewhere.
};

}  // namespace ldo::LDO_ISA
