// Gaussian window of SSIM (11 taps, sigma 1.5), along rows and across them.
#pragma once
#include <type_traits>

#include "simd.hpp"

namespace ldo::LDO_ISA {

constexpr int kReach = 5;  // Taps on each side of the middle one.
constexpr int kTaps = 2 * kReach + 1;
// exp(-k^2 / (2 1.5^2)) / sum, for k = 0 .. 5.
constexpr float kTap[kReach + 1] = {0.26601171f, 0.21300553f, 0.10936069f,
                                    0.03600077f, 0.00759876f, 0.00102838f};

template <int K>
using Offset = std::integral_constant<int, K>;

// Add the values K, K + 1, ... kReach places away on both sides, times their taps, to `sum`.
template <int K, class At>
[[gnu::always_inline]] inline Floats add_taps(const At& at, Floats sum) {
  if constexpr (K > kReach)
    return sum;
  else
    return add_taps<K + 1>(at, sum + (at(Offset<K>()) + at(Offset<-K>())) * kTap[K]);
}

// Return the windowed sum at sixteen places. `at(Offset<k>())` returns the values k places to the
// right or below.
template <class At>
[[gnu::always_inline]] inline Floats window(const At& at) {
  return add_taps<1>(at, at(Offset<0>()) * kTap[0]);
}

// kStrip columns of an image are processed together. The margin on each side, in whole vectors,
// serves two windows one after the other. The constant width puts rows at constant distances.
constexpr int kMargin = kLanes;
constexpr int kStrip = 320;
constexpr int kColumns = kStrip + 2 * kMargin;
static_assert(kMargin >= 2 * kReach && kStrip % kLanes == 0);

// Ring of the last rows of a few images of one strip. Row numbers may be negative.
template <int Images>
class RowRing {
 public:
  float* row(int y, int image) { return rows_[(y + kTaps) % kTaps][image]; }

  void clear(int y) { std::memset(rows_[(y + kTaps) % kTaps], 0, sizeof rows_[0]); }

  // Rows around y, for the vertical window.
  class Around {
   public:
    Around(RowRing& ring, int y) {
      for (int k = 0; k < kTaps; ++k) row_[k] = ring.row(y + k - kReach, 0);
    }
    [[gnu::always_inline]] inline Floats operator()(int image, int column) const {
      return window([&](auto k) __attribute__((always_inline)) {
        return Floats::load(row_[kReach + k()] + image * kColumns + column);
      });
    }

   private:
    const float* row_[kTaps];
  };

 private:
  alignas(64) float rows_[kTaps][Images][kColumns];
};

}  // namespace ldo::LDO_ISA
