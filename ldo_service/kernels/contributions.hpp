// Contributions of splats to the pixels of a tile.
#pragma once
#include "blend.hpp"

namespace ldo::LDO_ISA {

class TileContributions {
 public:
  TileContributions(int column, int row, const View& view)
      : x_(column * kTile), y_(row * kTile), view_(view) {}

  // Write the weights of the n splats of the list, summed over the pixels of the tile. Write to the
  // image `top` the row of the Gaussian with the largest weight at each pixel; -1 if no splat has
  // weight there. If weights are equal, the first splat counts.
  void operator()(const VisibleSplats& visible, const uint32_t* list, int64_t n,
                  const TileRecord& record, float* weights, int32_t* top) const {
    std::fill(weights, weights + n, 0.0f);
    for (int b = 0; b < kBlocks; ++b) {
      const int x = x_ + b % 4 * 4, y = y_ + b / 4 * 4;
      if (x >= view_.width || y >= view_.height) continue;
      Sight sight(lanes_, x, y, view_);
      each_sixteen_blended(record, b, n, [&](int64_t first, const uint32_t* places, int count) {
        add_sixteen(sight, visible.splats.data(), list, first, places, count, weights);
      });
      store_top(sight, visible.gaussians.data(), list, x, y, top);
    }
  }

 private:
  struct Sight {  // State of sixteen pixels, from front to back.
    Sight(const Lanes& lanes, int x, int y, const View& view)
        : px(lanes.x + static_cast<float>(x)), py(lanes.y + static_cast<float>(y)) {
      const Mask inside =
          (px < static_cast<float>(view.width)) & (py < static_cast<float>(view.height));
      transmittance = select(inside, 1.0f, 0.0f);
    }
    Floats px, py, transmittance;
    // Largest weight so far, and its position in the list, exact below 2^24.
    Floats largest = 0.0f, place = 0.0f;
  };

  void add_sixteen(Sight& sight, const Splat* splats, const uint32_t* list, int64_t first,
                   const uint32_t* places, int count, float* sums) const {
    alignas(64) FloatsRow weights[kLanes];
    for (int i = 0; i < count; ++i) {
      const int64_t place = first + places[i];
      const Splat& s = splats[list[place]];
      const Floats weight =
          capped_alpha(log2_alpha_of(s, sight.px - s.u, sight.py - s.v)) * sight.transmittance;
      sight.transmittance = sight.transmittance - weight;
      sight.place = select(sight.largest < weight, static_cast<float>(place), sight.place);
      sight.largest = max(sight.largest, weight);
      weight.store(weights[i]);
    }
    Floats by_pixel[kLanes], sum = 0.0f;
    transpose(weights, count, by_pixel);
    for (const Floats& pixel : by_pixel) sum = sum + pixel;
    alignas(64) float of_splat[kLanes];
    sum.store(of_splat);
    for (int i = 0; i < count; ++i) sums[first + places[i]] += of_splat[i];
  }

  void store_top(const Sight& sight, const uint32_t* gaussians, const uint32_t* list, int x, int y,
                 int32_t* top) const {
    alignas(64) float largest[kLanes], place[kLanes];
    sight.largest.store(largest);
    sight.place.store(place);
    for (int i = 0; i < kLanes; ++i) {
      const int column = x + i % 4, row = y + i / 4;
      if (column >= view_.width || row >= view_.height) continue;
      top[static_cast<int64_t>(row) * view_.width + column] =
          largest[i] > 0.0f ? static_cast<int32_t>(gaussians[list[static_cast<int64_t>(place[i])]])
                            : -1;
    }
  }

  const int x_, y_;
  const View& view_;
  const Lanes lanes_;
};

}  // namespace ldo::LDO_ISA
