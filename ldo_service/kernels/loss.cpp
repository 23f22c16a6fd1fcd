// Compiled once per instruction set, LDO_ISA.
//
// SSIM (Wang et al. 2004) needs of the frame y and the rendering x the windowed means of x, y,
// x^2 + y^2 and x y. Rows stream through two rings of eleven: the means, then the derivatives of
// SSIM by three of them, which the same window carries back to the pixels.
#include "loss.hpp"

#include <cmath>

#include "buffer.hpp"
#include "gaussian_window.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {
namespace {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // of SSIM, for values in 0..1
constexpr int kBandRows = 120;  // of one job; more lose less at the seams, fewer share better

struct RowSums {  // of one channel of one row
  float l1 = 0, ssim = 0, squares = 0, gain = 0, bias = 0;
};

inline Floats sign(Floats x) {
  return select(x < 0.0f, -1.0f, select(Floats(0.0f) < x, 1.0f, 0.0f));
}

// f(x) for the first pixel of each vector of a row; the last may reach beyond its end.
template <class F>
void each_vector(int width, F f) {
  for (int x = 0; x < width; x += kLanes) f(x);
}

class ChannelBand {
 public:
  ChannelBand(const LossInput& in, int channel, int first_row, int end_row, LossOutput& out,
              RowSums* sums)
      : in_(in),
        first_(first_row),
        end_(end_row),
        size_(static_cast<int64_t>(in.width) * in.height),
        rendered_(in.planes + channel * size_),
        target_(in.color + channel * size_),
        gradients_(out.gradients + channel * size_),
        gain_(in.exposure[channel]),
        bias_(in.exposure[3 + channel]),
        sums_(sums),
        memory_(5 * PaddedRow::floats(in.width) + 7 * RowRing::floats(in.width)) {
    float* next = memory_.data();
    for (float*& row : padded_) {
      row = PaddedRow(next, in.width).first();
      next += PaddedRow::floats(in.width);
    }
    for (RowRing& ring : rings_) {
      ring = RowRing(next, in.width);
      next += RowRing::floats(in.width);
    }
  }

  void run() {
    for (int y = first_ - 2 * kReach; y < end_ + 2 * kReach; ++y) {
      push_means(y);
      if (y >= first_) push_derivatives(y - kReach);
      if (y >= first_ + 2 * kReach) finish(y - 2 * kReach);
    }
  }

 private:
  enum { kX, kY, kSquares, kProduct, kDx, kDSquares, kDProduct };  // rings
  bool is_inside(int y) const { return y >= 0 && y < in_.height; }

  // x and y of a row of pixels, exposure and mask applied, zero beyond its end.
  void load(int row, float* x, float* y) const {
    const int64_t at = static_cast<int64_t>(row) * in_.width;
    for (int i = 0; i < in_.width; ++i) {
      x[i] = gain_ * rendered_[at + i] + bias_;
      y[i] = static_cast<float>(target_[at + i]) * (1.0f / 255.0f);
    }
    if (in_.mask == nullptr) return;
    for (int i = 0; i < in_.width; ++i)
      if (in_.mask[at + i] == 0) x[i] = y[i] = 0.0f;
  }

  void across(const float* padded, float* out) const {
    each_vector(in_.width, [&](int i) {
      window([&](int k) { return Floats::load(padded + i + k); }).store(out + i);
    });
  }

  void push_means(int row) {
    if (!is_inside(row)) return clear(row, kX, kProduct);
    float *x = padded_[0], *y = padded_[1], *squares = padded_[2], *product = padded_[3];
    load(row, x, y);
    each_vector(in_.width, [&](int i) {
      const Floats a = Floats::load(x + i), b = Floats::load(y + i);
      (a * a + b * b).store(squares + i);
      (a * b).store(product + i);
    });
    for (int k = 0; k < 4; ++k) across(padded_[k], rings_[kX + k].row(row));
  }

  void push_derivatives(int row) {
    if (!is_inside(row)) return clear(row, kDx, kDProduct);
    Floats sum = 0.0f;
    const Floats lanes = lane_numbers();
    Rows means[4];
    for (int k = 0; k < 4; ++k) means[k] = rows_about(rings_[kX + k], row);
    each_vector(in_.width, [&](int i) {
      const Floats mx = down(means[kX], i), my = down(means[kY], i);
      const Floats covariance = down(means[kProduct], i) - mx * my;
      const Floats squares = mx * mx + my * my, variances = down(means[kSquares], i) - squares;
      const Floats a1 = mx * my * 2.0f + kC1, a2 = covariance * 2.0f + kC2;
      const Floats b1 = squares + kC1, b2 = variances + kC2;
      const Floats inverse = Floats(1.0f) / (b1 * b2);
      const Floats ssim = a1 * a2 * inverse, by_b1 = ssim * inverse * b2,
                   by_b2 = ssim * inverse * b1;
      const Floats by_product = a1 * inverse * 2.0f;
      const Floats by_x = my * (a2 * inverse * 2.0f - by_product) - mx * (by_b1 - by_b2) * 2.0f;
      const Mask inside = lanes < static_cast<float>(in_.width - i);
      sum = sum + select(inside, ssim, 0.0f);
      select(inside, by_x, 0.0f).store(padded_[0] + i);
      select(inside, Floats(0.0f) - by_b2, 0.0f).store(padded_[2] + i);
      select(inside, by_product, 0.0f).store(padded_[3] + i);
    });
    if (row >= first_ && row < end_) sums_[row].ssim = LDO_ISA::sum(sum);
    across(padded_[0], rings_[kDx].row(row));
    across(padded_[2], rings_[kDSquares].row(row));
    across(padded_[3], rings_[kDProduct].row(row));
  }

  // L1 and all derivatives of a row whose SSIM windows are complete.
  void finish(int row) {
    float *x = padded_[0], *y = padded_[1], *out = padded_[4];
    load(row, x, y);
    const float per_value = 1.0f / (3.0f * static_cast<float>(size_));
    const float l1 = in_.weights.l1 * per_value, d_ssim = -in_.weights.d_ssim * per_value;
    Floats absolute = 0.0f, squares = 0.0f;
    const Rows dx = rows_about(rings_[kDx], row), ds = rows_about(rings_[kDSquares], row),
               dp = rows_about(rings_[kDProduct], row);
    each_vector(in_.width, [&](int i) {
      const Floats a = Floats::load(x + i), b = Floats::load(y + i), difference = a - b;
      absolute = absolute + abs(difference);
      squares = squares + difference * difference;
      const Floats ssim = down(dx, i) + a * 2.0f * down(ds, i) + b * down(dp, i);
      (sign(difference) * l1 + ssim * d_ssim).store(out + i);
    });
    store_gradients(row, out);
    RowSums& sums = sums_[row];
    sums.l1 = LDO_ISA::sum(absolute);
    sums.squares = LDO_ISA::sum(squares);
  }

  void store_gradients(int row, float* by_exposed) {
    const int64_t at = static_cast<int64_t>(row) * in_.width;
    if (in_.mask != nullptr)
      for (int i = 0; i < in_.width; ++i)
        if (in_.mask[at + i] == 0) by_exposed[i] = 0.0f;
    Floats gain = 0.0f, bias = 0.0f;
    std::memset(by_exposed + in_.width, 0, kLanes * sizeof(float));
    int i = 0;
    for (; i + kLanes <= in_.width; i += kLanes) {
      const Floats g = Floats::load(by_exposed + i);
      gain = gain + g * Floats::load(rendered_ + at + i);
      bias = bias + g;
      (g * gain_).store(gradients_ + at + i);
    }
    RowSums& sums = sums_[row];
    sums.gain = LDO_ISA::sum(gain);
    sums.bias = LDO_ISA::sum(bias);
    for (; i < in_.width; ++i) {
      sums.gain += by_exposed[i] * rendered_[at + i];
      sums.bias += by_exposed[i];
      gradients_[at + i] = by_exposed[i] * gain_;
    }
  }

  struct Rows {  // eleven about one, of which the middle is [kReach]
    const float* row[kTaps];
  };
  static Rows rows_about(const RowRing& ring, int row) {
    Rows out;
    for (int k = 0; k < kTaps; ++k) out.row[k] = ring.row(row + k - kReach);
    return out;
  }
  static Floats down(const Rows& rows, int i) {
    return window([&](int k) { return Floats::load(rows.row[kReach + k] + i); });
  }
  static Floats lane_numbers() {
    alignas(64) float numbers[kLanes];
    for (int i = 0; i < kLanes; ++i) numbers[i] = static_cast<float>(i);
    return Floats::load(numbers);
  }
  void clear(int row, int first, int last) {
    for (int k = first; k <= last; ++k)
      std::memset(rings_[k].row(row), 0, in_.width * sizeof(float));
  }

  const LossInput& in_;
  const int first_, end_;
  const int64_t size_;
  const float* rendered_;
  const uint8_t* target_;
  float* gradients_;
  const float gain_, bias_;
  RowSums* sums_;
  Buffer<float> memory_;
  float* padded_[5];
  RowRing rings_[7];
};

struct DepthSums {  // of one row
  float absolute = 0;
  int64_t count = 0;
};

bool counts(const LossInput& in, int64_t pixel) {
  return in.depth[pixel] > 0.0f && (in.mask == nullptr || in.mask[pixel] != 0);
}

// The depths that were measured, row by row; a derivative needs their number first.
void depth_loss(const LossInput& in, int threads, LossOutput& out) {
  Buffer<DepthSums> rows(in.height);
  const int64_t size = static_cast<int64_t>(in.width) * in.height;
  const float* rendered = in.planes + 3 * size;
  float *by_depth = out.gradients + 3 * size, *by_opacity = out.gradients + 4 * size;
  parallel_for(in.height, threads, [&](int64_t y) {
    DepthSums sums;
    for (int64_t i = y * in.width; i < (y + 1) * in.width; ++i) sums.count += counts(in, i);
    rows[y] = sums;
  });
  int64_t count = 0;
  for (int y = 0; y < in.height; ++y) count += rows[y].count;
  const float step = count > 0 ? in.weights.depth / static_cast<float>(count) : 0.0f;
  parallel_for(in.height, threads, [&](int64_t y) {
    float absolute = 0.0f;
    for (int64_t i = y * in.width; i < (y + 1) * in.width; ++i) {
      const float difference = counts(in, i) ? rendered[i] - in.depth[i] : 0.0f;
      absolute += std::fabs(difference);
      by_depth[i] = difference > 0.0f ? step : difference < 0.0f ? -step : 0.0f;
      by_opacity[i] = 0.0f;
    }
    rows[y].absolute = absolute;
  });
  out.depth = 0.0;
  for (int y = 0; y < in.height; ++y) out.depth += rows[y].absolute;
  if (count > 0) out.depth /= static_cast<double>(count);
}

}  // namespace

void image_loss(const LossInput& in, int threads, LossOutput& out) {
  Buffer<RowSums> rows(3 * static_cast<size_t>(in.height));
  const int bands = (in.height + kBandRows - 1) / kBandRows;
  parallel_for(3 * bands, threads, [&](int64_t job) {
    const int channel = static_cast<int>(job / bands), band = static_cast<int>(job % bands);
    const int first = band * kBandRows, end = std::min(in.height, first + kBandRows);
    ChannelBand(in, channel, first, end, out, &rows[static_cast<size_t>(channel) * in.height])
        .run();
  });
  const double values = 3.0 * in.width * in.height;
  double ssim = 0.0;
  out.l1 = out.squared_error = 0.0;
  std::fill(out.exposure, out.exposure + 6, 0.0);
  for (int channel = 0; channel < 3; ++channel)
    for (int y = 0; y < in.height; ++y) {
      const RowSums& sums = rows[static_cast<size_t>(channel) * in.height + y];
      out.l1 += sums.l1 / values;
      ssim += sums.ssim / values;
      out.squared_error += sums.squares / values;
      out.exposure[channel] += sums.gain;
      out.exposure[3 + channel] += sums.bias;
    }
  out.d_ssim = 1.0 - ssim;
  depth_loss(in, threads, out);
}

}  // namespace ldo::LDO_ISA
