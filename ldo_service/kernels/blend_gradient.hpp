// Derivative of the blending of one tile, computed front to back like the blending itself.
//
// At a pixel, let w_i = alpha_i T_i and q_i = dL/dC . c_i + dL/dD z_i + dL/dO. To first order, the
// contribution of splat i to L is w_i q_i. The derivative is
//   dL/d ln(alpha_i) = w_i (q_i - m_i),  m_i = sum_{j > i} w_j q_j / T_{i+1}.
// This compares the value q_i of the splat with the mean value m_i of the splats behind it. The sum
// of w_j q_j over all j is known from the images. Subtracting the terms of the splats in front
// gives m behind every sixteenth splat. From there, m_{i-1} = alpha_i q_i + (1 - alpha_i) m_i gives
// m of the sixteen splats, back to front, without a division. At each of these steps, the rounding
// error of m shrinks by the factor T_{i+1} / T_i.
#pragma once
#include "blend.hpp"

namespace ldo::LDO_ISA {

// Sums over the pixels of a tile for one splat, with v = dL/d ln(alpha) and d = pixel - (u, v).
enum SplatSum {
  kV,
  kVx,
  kVy,
  kVxx,
  kVxy,
  kVyy,  // The six sums up to here: v, v dx, v dy, v dx^2, v dx dy, v dy^2.
  kWeightRed,
  kWeightGreen,
  kWeightBlue,   // The three sums of w dL/dC.
  kWeightDepth,  // w dL/dD
  kWeightSum,    // w
  kSplatSums,
};
constexpr int kSumFloats = 16;  // One cache line.

// Sums over columns x of f, f x and f x^2, for x = -1.5, -0.5, 0.5, 1.5.
struct Moments {
  [[gnu::always_inline]] inline Moments(Floats f0, Floats f1, Floats f2, Floats f3) {
    const Floats outer = f0 + f3, inner = f1 + f2;
    zeroth = outer + inner;
    first = (f3 - f0) * 1.5f + (f2 - f1) * 0.5f;
    second = outer * 2.25f + inner * 0.25f;
  }
  Floats zeroth, first, second;
};

// State of sixteen pixels during the pass from front to back, sixteen splats at a time.
struct BlockGradient {
  Floats px, py;             // Pixel coordinates.
  Floats gradient[kPlanes];  // Gradient of L by the images.
  Floats behind;             // Sum of w q over the splats that are not processed yet.
  Floats transmittance = 1.0f;

  // Compute the weights and v of the next `count` splats, which `next(i)` returns.
  template <class Next>
  [[gnu::always_inline]] inline void differentiate(int count, const Next& next, FloatsRow* weights,
                                                   FloatsRow* v) {
    alignas(64) FloatsRow alphas[kLanes], qs[kLanes];
    for (int i = 0; i < count; ++i) {
      const Splat& s = next(i);
      const Floats alpha = capped_alpha(log2_alpha_of(s, px - s.u, py - s.v));
      const Floats q =
          gradient[kRed] * s.color[0] +
          (gradient[kGreen] * s.color[1] +
           (gradient[kBlue] * s.color[2] + (gradient[kDepth] * s.z + gradient[kPlaneOpacity])));
      const Floats weight = alpha * transmittance;
      transmittance = transmittance - weight;
      behind = behind - weight * q;
      weight.store(weights[i]);
      alpha.store(alphas[i]);
      q.store(qs[i]);
    }
    Floats mean = behind / max(transmittance, kLeastTransmittance);
    for (int i = count - 1; i >= 0; --i) {
      const Floats alpha = Floats::load(alphas[i]), q = Floats::load(qs[i]);
      select(alpha < kCapped, Floats::load(weights[i]) * (q - mean), 0.0f).store(v[i]);
      mean = alpha * q + (Floats(1.0f) - alpha) * mean;
    }
  }

 private:
  // Lower bound of the divisor, which prevents 0 / 0. In a pixel of less transmittance, the error
  // that it causes is far smaller than the contribution of the pixel.
  static constexpr float kLeastTransmittance = 1e-30f;
};

// Compute the moments of v about the centers (mx, my) of the splats, which are relative to the
// center of the block. Each vector of `v` holds one pixel, with one lane per splat.
[[gnu::always_inline]] inline void moments_about_mean(const Floats (&v)[kLanes], Floats mx,
                                                      Floats my, Floats* out) {
  const Moments r0(v[0], v[1], v[2], v[3]), r1(v[4], v[5], v[6], v[7]),
      r2(v[8], v[9], v[10], v[11]), r3(v[12], v[13], v[14], v[15]);
  const Moments by_y(r0.zeroth, r1.zeroth, r2.zeroth, r3.zeroth);
  const Moments x_by_y(r0.first, r1.first, r2.first, r3.first);
  const Floats xx = r0.second + r1.second + (r2.second + r3.second);
  const Floats x = x_by_y.zeroth, y = by_y.first;
  out[kV] = by_y.zeroth;
  out[kVx] = x - mx * out[kV];
  out[kVy] = y - my * out[kV];
  out[kVxx] = xx - mx * (x + out[kVx]);
  out[kVxy] = x_by_y.first - my * x - mx * out[kVy];
  out[kVyy] = by_y.second - my * (y + out[kVy]);
}

// Gradient sums of the splats of one tile.
class TileGradient {
 public:
  TileGradient(int column, int row, const View& view, const float* planes, const float* gradients)
      : x_(column * kTile), y_(row * kTile), view_(view), planes_(planes), gradients_(gradients) {}

  // Write kSumFloats sums for each of the n splats of the list. The `ahead` entries that follow in
  // the list are splats of the next tile; they are prefetched meanwhile.
  void operator()(const Splat* splats, const uint32_t* list, int64_t n, int64_t ahead,
                  const TileRecord& record, float* sums) {
    std::memset(sums, 0, n * kSumFloats * sizeof(float));
    for (int b = 0; b < kBlocks; ++b) {
      for (int64_t i = ahead * b / kBlocks; i < ahead * (b + 1) / kBlocks; ++i)
        __builtin_prefetch(&splats[list[n + i]]);
      prefetch_row(b);
      if (record.blended[b] > 0) differentiate_block(b, splats, list, n, record, sums);
    }
  }

 private:
  // Prefetch pixel row `row` of the next tile, from all planes and from all gradients.
  [[gnu::always_inline]] inline void prefetch_row(int row) const {
    if (x_ + kTile >= view_.width || y_ + row >= view_.height) return;
    const int64_t size = static_cast<int64_t>(view_.width) * view_.height;
    const int64_t pixel = static_cast<int64_t>(y_ + row) * view_.width + x_ + kTile;
    for (int k = 0; k < kPlanes; ++k) {
      __builtin_prefetch(planes_ + k * size + pixel);
      __builtin_prefetch(gradients_ + k * size + pixel);
    }
  }

  static constexpr int kFactors = 5;  // Factors of the weights in the sums: dL/dC, dL/dD and one.

  void differentiate_block(int b, const Splat* splats, const uint32_t* list, int64_t n,
                           const TileRecord& record, float* sums) {
    const float x = static_cast<float>(x_ + b % 4 * 4), y = static_cast<float>(y_ + b / 4 * 4);
    BlockGradient block = open_block(b);
    each_sixteen_blended(record, b, n,
                         [&](int64_t first, const uint32_t* places, int count)
                             __attribute__((always_inline)) {
                               add_sixteen(block, x + 1.5f, y + 1.5f, splats, list + first, places,
                                           count, sums + first * kSumFloats);
                             });
  }

  [[gnu::always_inline]] inline BlockGradient open_block(int b) {
    const int x = x_ + b % 4 * 4, y = y_ + b / 4 * 4;
    const int64_t size = static_cast<int64_t>(view_.width) * view_.height;
    const PixelBlock pixels(x, y, view_);
    BlockGradient block;
    block.px = lanes_.x + static_cast<float>(x);
    block.py = lanes_.y + static_cast<float>(y);
    block.behind = 0.0f;
    for (int k = 0; k < kPlanes; ++k) {
      block.gradient[k] = pixels.load(gradients_ + k * size);
      block.behind = block.behind + block.gradient[k] * pixels.load(planes_ + k * size);
    }
    for (int k = 0; k < kFactors - 1; ++k) block.gradient[k].store(factors_[k]);
    const Mask inside = (block.px < static_cast<float>(view_.width)) &
                        (block.py < static_cast<float>(view_.height));
    select(inside, 1.0f, 0.0f).store(factors_[kFactors - 1]);
    return block;
  }

  [[gnu::always_inline]] inline void add_sixteen(BlockGradient& block, float center_x,
                                                 float center_y, const Splat* splats,
                                                 const uint32_t* list, const uint32_t* places,
                                                 int count, float* sums) {
    alignas(64) FloatsRow weights[kLanes], v[kLanes];
    alignas(64) float mean_x[kLanes] = {}, mean_y[kLanes] = {};
    const auto next = [&](int i) -> const Splat& {
      const Splat& s = splats[list[places[i]]];
      mean_x[i] = s.u - center_x;
      mean_y[i] = s.v - center_y;
      return s;
    };
    block.differentiate(count, next, weights, v);
    Floats by_pixel[kLanes], out[kLanes];
    // The weights come first, because they do not depend on v.
    transpose(weights, count, by_pixel);
    sum_weights(by_pixel, out + kWeightRed);
    transpose(v, count, by_pixel);
    moments_about_mean(by_pixel, Floats::load(mean_x), Floats::load(mean_y), out);
    for (int k = kSplatSums; k < kSumFloats; ++k) out[k] = 0.0f;
    transpose(out);
    for (int i = 0; i < count; ++i) {
      float* row = sums + static_cast<int64_t>(places[i]) * kSumFloats;
      (Floats::load(row) + out[i]).store(row);
    }
  }

  // Sum the weights times the factors. Each vector of `weights` holds one pixel, with one lane per
  // splat.
  [[gnu::always_inline]] inline void sum_weights(const Floats (&weights)[kLanes],
                                                 Floats* out) const {
    Floats sums[kFactors] = {0.0f, 0.0f, 0.0f, 0.0f, 0.0f};
#pragma GCC unroll 16
    for (int pixel = 0; pixel < kLanes; ++pixel)
      for (int k = 0; k < kFactors; ++k) sums[k] = sums[k] + weights[pixel] * factors_[k][pixel];
    for (int k = 0; k < kFactors; ++k) out[k] = sums[k];
  }

  const int x_, y_;
  const View& view_;
  const float *planes_, *gradients_;
  const Lanes lanes_;
  alignas(64) float factors_[kFactors][kLanes];  // Factors of the open block.
};

}  // namespace ldo::LDO_ISA
