// Image loss, compiled once per instruction set (macro LDO_ISA).
//
// SSIM (Wang et al. 2004) of the frame y and the rendering x needs the windowed means of x, y,
// x^2 + y^2 and x y. The rows of the image pass through two ring buffers of eleven rows. The first
// holds the means, the second the derivatives of SSIM by three of the means. Applying the same
// window to the derivatives gives the derivatives by the pixels.
#include "loss.hpp"

#include <algorithm>
#include <cmath>

#include "buffer.hpp"
#include "gaussian_window.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {
namespace {

constexpr float kC1 = 0.01f * 0.01f, kC2 = 0.03f * 0.03f;  // Constants of SSIM, for values in 0..1.
// Maximum rows of a job. With more rows, fewer are computed twice at the seams between jobs; with
// fewer rows, the load of the threads is more equal.
constexpr int kBand = 240;

inline Floats sign(Floats x) {
  return select(x < 0.0f, -1.0f, select(Floats(0.0f) < x, 1.0f, 0.0f));
}

struct RowSums {  // Sums of one channel of one row of a strip.
  float l1 = 0, ssim = 0, squares = 0;
};

struct Part {  // Part of the image that one job processes.
  int channel, left, right, top, bottom;
};

// Division of an image into parts of about equal size, so that they take equal time. Each channel
// has at least two strips: six parts balance better among a few threads than three.
struct Cut {
  Cut(int width, int height)
      : width(width),
        height(height),
        strip(ceil(ceil(width, std::max(2, ceil(width, kStrip))), kLanes) * kLanes),
        strips(ceil(width, strip)),
        bands(ceil(height, kBand)),
        band(ceil(height, bands)) {}

  int columns() const { return 3 * strips; }  // Strips of all channels.
  int parts() const { return columns() * bands; }
  int column_of(int part) const { return part / bands; }
  Part part(int number) const {
    const int column = column_of(number);
    const int left = column % strips * strip, top = number % bands * band;
    return {column / strips, left, std::min(width, left + strip), top,
            std::min(height, top + band)};
  }

  const int width, height, strip, strips, bands, band;  // A strip is in pixels, a band in rows.

 private:
  static int ceil(int n, int piece) { return (n + piece - 1) / piece; }
};

// Loss of one part of the image. `sums` has one entry for each row of the image.
class PartLoss {
 public:
  PartLoss(const LossInput& in, const Part& part, float* gradients, RowSums* sums)
      : in_(in),
        part_(part),
        first_column_(part.left - kMargin),
        end_((part.right - part.left + kLanes - 1) / kLanes * kLanes + kMargin),
        rendered_(in.planes + part.channel * size()),
        target_(in.color + part.channel * size()),
        gradients_(gradients + part.channel * size()),
        gain_(in.exposure[part.channel]),
        bias_(in.exposure[3 + part.channel]),
        sums_(sums) {
    std::memset(pixels_, 0, sizeof pixels_);
  }

  void run() {
    for (int y = part_.top - 2 * kReach; y < part_.bottom + 2 * kReach; ++y) {
      push_means(y);
      if (y >= part_.top) push_derivatives(y - kReach);
      if (y >= part_.top + 2 * kReach) finish(y - 2 * kReach);
    }
  }

 private:
  enum Mean { kX, kY, kSquares, kProduct, kMeans };
  enum Derivative { kByX, kBySquares, kByProduct, kDerivatives };

  int64_t size() const { return static_cast<int64_t>(in_.width) * in_.height; }
  bool is_inside(int y) const { return y >= 0 && y < in_.height; }
  float* pixels(int image) { return pixels_[image] + kLanes; }

  // Call f(column) for the first column of each vector in [begin, end).
  template <class F>
  static void each_vector(int begin, int end, F f) {
    for (int i = begin; i < end; i += kLanes) f(i);
  }

  // Load x and y of a row of pixels, with exposure and mask applied; zero outside the image.
  void load(int row) {
    const int begin = std::max(0, -first_column_),
              end = std::min(end_ + kMargin, in_.width - first_column_);
    const int64_t at = static_cast<int64_t>(row) * in_.width + first_column_;
    float *x = pixels(kX), *y = pixels(kY);
    for (int i = begin; i < end; ++i) {
      x[i] = gain_ * rendered_[at + i] + bias_;
      y[i] = static_cast<float>(target_[at + i]) * (1.0f / 255.0f);
    }
    std::fill(x + end, x + kColumns, 0.0f);
    if (in_.mask == nullptr) return;
    for (int i = begin; i < end; ++i)
      if (in_.mask[at + i] == 0) x[i] = y[i] = 0.0f;
  }

  void push_means(int row) {
    if (!is_inside(row)) return means_.clear(row);
    load(row);
    const float *x = pixels(kX), *y = pixels(kY);
    each_vector(0, end_ + kMargin, [&](int i) {
      const Floats a = Floats::load(x + i), b = Floats::load(y + i);
      (a * a + b * b).store(pixels(kSquares) + i);
      (a * b).store(pixels(kProduct) + i);
    });
    for (int image = 0; image < kMeans; ++image)
      across(pixels(image), means_.row(row, image), 0, end_ + kMargin);
  }

  static void across(const float* from, float* to, int begin, int end) {
    each_vector(begin, end, [&](int i) __attribute__((always_inline)) {
      const Neighbors around(from + i);
      window([&](auto k) __attribute__((always_inline)) {
        return around.at<decltype(k)::value>();
      }).store(to + i);
    });
  }

  void push_derivatives(int row) {
    if (!is_inside(row)) return derivatives_.clear(row);
    const RowRing<kMeans>::Around mean(means_, row);
    Floats sum = 0.0f;
    each_vector(0, end_ + kMargin, [&](int i) {
      const Floats mx = mean(kX, i), my = mean(kY, i);
      const Floats covariance = mean(kProduct, i) - mx * my;
      const Floats squares = mx * mx + my * my, variances = mean(kSquares, i) - squares;
      const Floats a1 = mx * my * 2.0f + kC1, a2 = covariance * 2.0f + kC2;
      const Floats b1 = squares + kC1, b2 = variances + kC2;
      const Floats inverse = reciprocal(b1 * b2);
      const Floats ssim = a1 * a2 * inverse;
      const Floats by_b1 = ssim * inverse * b2, by_b2 = ssim * inverse * b1;
      const Floats by_product = a1 * inverse * 2.0f;
      const Floats by_x = my * (a2 * inverse * 2.0f - by_product) - mx * (by_b1 - by_b2) * 2.0f;
      const Mask in_image = is_between(i, 0, in_.width);
      select(in_image, by_x, 0.0f).store(pixels(kByX) + i);
      select(in_image, Floats(0.0f) - by_b2, 0.0f).store(pixels(kBySquares) + i);
      select(in_image, by_product, 0.0f).store(pixels(kByProduct) + i);
      if (i >= kMargin && i < end_)
        sum = sum + select(is_between(i, part_.left, part_.right), ssim, 0.0f);
    });
    if (row >= part_.top && row < part_.bottom) sums_[row].ssim = LDO_ISA::sum(sum);
    for (int image = 0; image < kDerivatives; ++image)
      across(pixels(image), derivatives_.row(row, image), kMargin, end_);
  }

  // Return the lanes of the vector at a column that lie in columns [left, right) of the image.
  Mask is_between(int column, int left, int right) const {
    const Floats x = lanes_ + static_cast<float>(first_column_ + column);
    return (x >= static_cast<float>(left)) & (x < static_cast<float>(right));
  }

  // Compute L1 and all derivatives of a row whose SSIM windows are complete.
  void finish(int row) {
    load(row);
    const RowRing<kDerivatives>::Around derivative(derivatives_, row);
    const float per_value = 1.0f / (3.0f * static_cast<float>(size()));
    const float l1 = in_.weights.l1 * per_value, d_ssim = -in_.weights.d_ssim * per_value;
    Floats absolute = 0.0f, squares = 0.0f;
    each_vector(kMargin, end_, [&](int i) {
      const Floats x = Floats::load(pixels(kX) + i), y = Floats::load(pixels(kY) + i);
      const Mask here = is_between(i, part_.left, part_.right);
      const Floats difference = select(here, x - y, 0.0f);
      absolute = absolute + abs(difference);
      squares = squares + difference * difference;
      const Floats by_ssim = derivative(kByX, i) + x * 2.0f * derivative(kBySquares, i) +
                             y * derivative(kByProduct, i);
      (sign(difference) * l1 + by_ssim * d_ssim).store(pixels(kProduct) + i);
    });
    sums_[row].l1 = LDO_ISA::sum(absolute);
    sums_[row].squares = LDO_ISA::sum(squares);
    store_gradients(row, pixels(kProduct));
  }

  void store_gradients(int row, float* by_exposed) {
    const int64_t at = static_cast<int64_t>(row) * in_.width + first_column_;
    const int end = part_.right - first_column_;
    if (in_.mask != nullptr)
      for (int i = kMargin; i < end; ++i)
        if (in_.mask[at + i] == 0) by_exposed[i] = 0.0f;
    int i = kMargin;
    for (; i + kLanes <= end; i += kLanes)
      (Floats::load(by_exposed + i) * gain_).store(gradients_ + at + i);
    for (; i < end; ++i) gradients_[at + i] = by_exposed[i] * gain_;
  }

  const LossInput& in_;
  const Part part_;
  const int first_column_;  // Image column that column 0 of all row buffers holds.
  const int end_;           // Column after the last vector with pixels of this part.
  const float* rendered_;
  const uint8_t* target_;
  float* gradients_;
  const float gain_, bias_;
  RowSums* sums_;
  const Floats lanes_ = Floats::ramp();
  alignas(64) float pixels_[kMeans][kColumns + 2 * kLanes];  // One row, with zeros on both sides.
  RowRing<kMeans> means_;
  RowRing<kDerivatives> derivatives_;
};

// Call f(index of the first pixel, count, depths) for each sixteen pixels of a row. The depth is
// zero where it was not measured or is masked.
template <class F>
void each_depth(const LossInput& in, int64_t row, F f) {
  const int64_t begin = row * in.width;
  for (int i = 0; i < in.width; i += kLanes) {
    const int n = std::min(kLanes, in.width - i);
    alignas(64) float depth[kLanes] = {};
    std::memcpy(depth, in.depth + begin + i, n * sizeof(float));
    for (int k = 0; in.mask != nullptr && k < n; ++k)
      if (in.mask[begin + i + k] == 0) depth[k] = 0.0f;
    f(begin + i, n, Floats::load(depth));
  }
}

// Compute the depth loss and its derivative. The derivative needs the number of depths that count,
// so the first loop finds it.
void depth_loss(const LossInput& in, LossOutput& out) {
  const int64_t size = static_cast<int64_t>(in.width) * in.height;
  const float* rendered = in.planes + 3 * size;
  float *by_depth = out.gradients + 3 * size, *by_opacity = out.gradients + 4 * size;
  double count = 0.0;
  for (int y = 0; y < in.height; ++y) {
    Floats row = 0.0f;
    each_depth(in, y, [&](int64_t, int, Floats depth) {
      row = row + select(Floats(0.0f) < depth, 1.0f, 0.0f);
    });
    count += sum(row);
  }
  const float step = count > 0 ? in.weights.depth / static_cast<float>(count) : 0.0f;
  out.depth = 0.0;
  for (int y = 0; y < in.height; ++y) {
    Floats row = 0.0f;
    each_depth(in, y, [&](int64_t pixel, int n, Floats depth) {
      const Floats error = Floats::load_first(rendered + pixel, n) - depth;
      const Floats difference = select(Floats(0.0f) < depth, error, 0.0f);
      row = row + abs(difference);
      (sign(difference) * step).store_first(by_depth + pixel, n);
      Floats(0.0f).store_first(by_opacity + pixel, n);
    });
    out.depth += sum(row);
  }
  if (count > 0) out.depth /= count;
}

}  // namespace

void image_loss(const LossInput& in, int threads, LossOutput& out) {
  const Cut cut(in.width, in.height);
  Buffer<RowSums> sums(static_cast<size_t>(cut.columns()) * in.height);
  Team(threads).each(1 + cut.parts(), [&](int64_t job) {
    if (job == 0) return depth_loss(in, out);  // The depth loss takes about as long as one part.
    const int number = static_cast<int>(job - 1);
    RowSums* rows = &sums[static_cast<size_t>(cut.column_of(number)) * in.height];
    PartLoss(in, cut.part(number), out.gradients, rows).run();
  });
  const double values = 3.0 * in.width * in.height;
  double ssim = 0.0;
  out.l1 = out.squared_error = 0.0;
  for (int column = 0; column < cut.columns(); ++column)
    for (int y = 0; y < in.height; ++y) {
      const RowSums& row = sums[static_cast<size_t>(column) * in.height + y];
      out.l1 += row.l1 / values;
      ssim += row.ssim / values;
      out.squared_error += row.squares / values;
    }
  out.d_ssim = 1.0 - ssim;
}

}  // namespace ldo::LDO_ISA
