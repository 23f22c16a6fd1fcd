// The Gaussian window of SSIM (11 taps, sigma 1.5), along rows and across them.
#pragma once
#include "simd.hpp"

namespace ldo::LDO_ISA {

constexpr int kReach = 5;               // taps on each side of the middle one
constexpr int kTaps = 2 * kReach + 1;
// exp(-k^2 / (2 1.5^2)) / sum, for k = 0 .. 5
constexpr float kTap[kReach + 1] = {0.26601171f, 0.21300553f, 0.10936069f,
                                    0.03600077f, 0.00759876f, 0.00102838f};

// The windowed sum at sixteen places, of which `at(k)` gives the values k to the right or below.
template <class At>
[[gnu::always_inline]] inline Floats window(At at) {
  Floats sum = at(0) * kTap[0];
#pragma GCC unroll 5
  for (int k = 1; k <= kReach; ++k) sum = sum + (at(k) + at(-k)) * kTap[k];
  return sum;
}

// A row with room for what windows and whole vectors read beyond its ends: zeros.
class PaddedRow {
 public:
  static size_t floats(int width) { return (width + 2 * kLanes + kLanes - 1) / kLanes * kLanes; }
  PaddedRow(float* memory, int width) : first_(memory + kLanes) {
    std::memset(memory, 0, floats(width) * sizeof(float));
  }
  float* first() const { return first_; }

 private:
  float* first_;
};

// The last eleven rows of an image, found by their row number, which may be negative.
class RowRing {
 public:
  static size_t floats(int width) { return kTaps * stride(width); }
  RowRing() = default;
  RowRing(float* memory, int width) : memory_(memory), stride_(stride(width)) {}
  float* row(int y) const { return memory_ + (y + kTaps) % kTaps * stride_; }

 private:
  static size_t stride(int width) { return (width + kLanes - 1) / kLanes * kLanes; }
  float* memory_ = nullptr;
  size_t stride_ = 0;
};

}  // namespace ldo::LDO_ISA
