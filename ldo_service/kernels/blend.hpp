// Front-to-back blending of one tile: C = sum c_i alpha_i T_i, T_i = prod_{j < i} (1 - alpha_j).
#pragma once
#include "tiles.hpp"

namespace ldo::LDO_ISA {

constexpr float kLog2MaxAlpha = -0.0144995697f;  // log2(0.99)
constexpr float kStop = 1e-4f;                   // A pixel of less transmittance is finished.
constexpr int kBlocks = 16;                      // Blocks of 4x4 pixels in a tile.
constexpr int kBatch = 256;                      // Splats gathered before the blocks are blended.

struct Block {  // Sixteen pixels.
  Floats transmittance = 1.0f, red = 0.0f, green = 0.0f, blue = 0.0f, depth = 0.0f;
  Floats median_depth = 1e30f;  // Farther than any splat.
};

struct Lanes {  // Column and row of each lane in its 4x4 block.
  Lanes() {
    alignas(64) float column[kLanes], row[kLanes];
    for (int i = 0; i < kLanes; ++i) {
      column[i] = static_cast<float>(i % 4);
      row[i] = static_cast<float>(i / 4);
    }
    x = Floats::load(column);
    y = Floats::load(row);
  }
  Floats x, y;
};

// Block of 4x4 pixels at (x, y), clipped to the image.
class PixelBlock {
 public:
  PixelBlock(int x, int y, const View& view)
      : first_(static_cast<int64_t>(y) * view.width + x),
        stride_(view.width),
        columns_(std::min(4, view.width - x)),
        rows_(std::min(4, view.height - y)) {}

  Floats load(const float* plane) const {  // Pixels outside the image are zero.
    if (columns_ == 4 && rows_ == 4) return Floats::load_rows(plane + first_, stride_);
    alignas(64) float pixels[kLanes] = {};
    each_row([&](int row, auto columns) {
      std::memcpy(pixels + 4 * row, plane + first_ + row * stride_, columns * sizeof(float));
    });
    return Floats::load(pixels);
  }
  void store(Floats values, float* plane) const {
    alignas(64) float pixels[kLanes];
    values.store(pixels);
    each_row([&](int row, auto columns) {
      std::memcpy(plane + first_ + row * stride_, pixels + 4 * row, columns * sizeof(float));
    });
  }

 private:
  template <class F>
  void each_row(F f) const {
    if (columns_ == 4 && rows_ == 4) {  // A constant size compiles to plain moves.
      for (int row = 0; row < 4; ++row) f(row, std::integral_constant<int, 4>{});
    } else {
      for (int row = 0; columns_ > 0 && row < rows_; ++row) f(row, columns_);
    }
  }
  const int64_t first_, stride_;
  const int columns_, rows_;
};

// Return a mask with bit i set if the ellipse alpha >= 1/255 reaches block i of the tile at (x, y).
// In a block without the center of the splat, alpha is largest on one of the two sides that are
// nearest to the center. The ridge lines give the point of largest alpha on each of these sides.
inline uint32_t touched_blocks(const Splat& s, const Lanes& lanes, float x, float y) {
  const Floats x0 = lanes.x * 4.0f + (x - s.u), x1 = x0 + 3.0f;
  const Floats y0 = lanes.y * 4.0f + (y - s.v), y1 = y0 + 3.0f;
  const Floats side_x = clamp(0.0f, x0, x1), side_y = clamp(0.0f, y0, y1);
  const Floats best_y = clamp(side_x * s.y_slope, y0, y1);
  const Floats best_x = clamp(side_y * s.x_slope, x0, x1);
  const auto exponent = [&](Floats dx, Floats dy) {
    return dx * (dx * s.a + dy * s.b) + dy * dy * s.c;
  };
  // The margin of 1e-3 ensures that rounding here drops no pixel that the blending would count.
  const float least = kLog2MinAlpha - s.log2_opacity - 1e-3f;
  return bits(max(exponent(side_x, best_y), exponent(best_x, side_y)) >= least);
}

// Return log2 alpha = a dx^2 + b dx dy + c dy^2 + log2 o of one splat at sixteen pixels. The cap at
// 0.99 and the minimum of 1/255 are not applied yet.
[[gnu::always_inline]] inline Floats log2_alpha_of(const Splat& s, Floats dx, Floats dy) {
  return dx * (dx * s.a + dy * s.b) + (dy * dy * s.c + s.log2_opacity);
}

constexpr float kCapped = 0.98999f;  // A larger alpha was capped at 0.99, up to rounding.
[[gnu::always_inline]] inline Floats capped_alpha(Floats log2_alpha) {
  return select(log2_alpha >= kLog2MinAlpha, exp2(min(log2_alpha, kLog2MaxAlpha)), 0.0f);
}

// Add one splat to sixteen pixels at (px, py).
template <bool WithMedian>
[[gnu::always_inline]] inline void blend_splat(const Splat& s, Floats px, Floats py, Block& block) {
  const Floats weight = capped_alpha(log2_alpha_of(s, px - s.u, py - s.v)) * block.transmittance;
  block.red = block.red + weight * s.color[0];
  block.green = block.green + weight * s.color[1];
  block.blue = block.blue + weight * s.color[2];
  block.depth = block.depth + weight * s.z;
  block.transmittance = block.transmittance - weight;
  // Splats are blended by increasing z. The minimum is therefore the first z behind which the
  // transmittance is below one half.
  if constexpr (WithMedian)
    block.median_depth =
        select(block.transmittance < 0.5f, min(block.median_depth, s.z), block.median_depth);
}

// Record of the forward pass over a tile, for the backward pass.
struct TileRecord {
  // Blocks that each splat of the tile's list touches, up to the last splat examined.
  uint32_t* touched;
  uint32_t* blended;  // [kBlocks], number of splats that each block blended.
};

// Call f(first, places, count) for the splats that block b blended, front to back, sixteen at a
// time. Their positions in the tile's list of n splats are first + places[i], i < count.
template <class F>
[[gnu::always_inline]] inline void each_sixteen_blended(const TileRecord& record, int b, int64_t n,
                                                        const F& f) {
  constexpr int kLookedAt = 2048;  // Splats of the list that are searched at once.
  int64_t left = record.blended[b];
  for (int64_t first = 0; left > 0; first += kLookedAt) {
    alignas(64) uint32_t places[kLookedAt + kLanes];
    const int size = static_cast<int>(std::min<int64_t>(kLookedAt, n - first));
    const int64_t found = indices_with_bit(record.touched + first, size, b, places);
    const int count = static_cast<int>(std::min(left, found));
    for (int i = 0; i < count; i += kLanes) f(first, places + i, std::min(kLanes, count - i));
    left -= count;
  }
}

// Images of one tile during the forward pass.
class Tile {
 public:
  Tile(int column, int row, const View& view) : x_(column * kTile), y_(row * kTile), view_(view) {
    for (int b = 0; b < kBlocks; ++b)
      if (x_ + b % 4 * 4 < view.width && y_ + b / 4 * 4 < view.height) open_ |= 1u << b;
  }

  template <bool WithMedian>
  void blend(const Splat* splats, const uint32_t* list, int64_t n, const TileRecord& record) {
    for (int64_t first = 0; first < n && open_ != 0; first += kBatch)
      blend_batch<WithMedian>(splats, list + first, std::min<int64_t>(kBatch, n - first),
                              record.touched + first);
    std::copy(blended_, blended_ + kBlocks, record.blended);
  }

  void store(const Images& out) const {
    alignas(64) float planes[6][kTile][kTile];
    for (int b = 0; b < kBlocks; ++b) unpack(b, planes);
    const int width = std::min(kTile, view_.width - x_),
              height = std::min(kTile, view_.height - y_);
    for (int y = 0; y < height; ++y) {
      const int64_t pixel = static_cast<int64_t>(y_ + y) * view_.width + x_;
      for (int x = 0; x < width; ++x)
        for (int c = 0; c < 3; ++c) out.color[(pixel + x) * 3 + c] = planes[c][y][x];
      std::copy(planes[3][y], planes[3][y] + width, out.depth + pixel);
      std::copy(planes[4][y], planes[4][y] + width, out.median_depth + pixel);
      std::copy(planes[5][y], planes[5][y] + width, out.opacity + pixel);
    }
  }

  void store_planes(float* planes) const {
    const int64_t size = static_cast<int64_t>(view_.width) * view_.height;
    for (int b = 0; b < kBlocks; ++b) {
      const Block& block = blocks_[b];
      const PixelBlock pixels(x_ + b % 4 * 4, y_ + b / 4 * 4, view_);
      pixels.store(block.red, planes + kRed * size);
      pixels.store(block.green, planes + kGreen * size);
      pixels.store(block.blue, planes + kBlue * size);
      pixels.store(block.depth, planes + kDepth * size);
      pixels.store(Floats(1.0f) - block.transmittance, planes + kPlaneOpacity * size);
    }
  }

 private:
  template <bool WithMedian>
  void blend_batch(const Splat* splats, const uint32_t* list, int64_t n, uint32_t* touched) {
    gather(splats, list, static_cast<int>(n), touched);
    for (int b = 0; b < kBlocks; ++b)
      if (open_ >> b & 1) blend_block<WithMedian>(b, static_cast<int>(n), touched);
  }

  void gather(const Splat* splats, const uint32_t* list, int n, uint32_t* touched) {
    const float x = static_cast<float>(x_), y = static_cast<float>(y_);
    for (int i = 0; i < n; ++i) {
      __builtin_prefetch(&splats[list[i + kPrefetchAhead]]);
      batch_[i] = splats[list[i]];
      touched[i] = touched_blocks(batch_[i], lanes_, x, y);
    }
  }

  template <bool WithMedian>
  void blend_block(int b, int n, const uint32_t* touched) {
    const Floats px = lanes_.x + static_cast<float>(x_ + b % 4 * 4);
    const Floats py = lanes_.y + static_cast<float>(y_ + b / 4 * 4);
    alignas(64) uint32_t list[kBatch + kLanes];
    n = indices_with_bit(touched, n, b, list);
    Block block = blocks_[b];
    int i = 0;
    bool is_open = true;
    const auto blend_while = [&](auto with_median, float least) {
      while (i < n) {
        blend_splat<with_median>(batch_[list[i]], px, py, block);
        if (++i % 4 == 0 && !any(block.transmittance >= least)) break;
      }
    };
    if (WithMedian && any(block.transmittance >= 0.5f)) {
      blend_while(std::true_type{}, 0.5f);  // The medians are final after this loop.
      is_open = any(block.transmittance >= kStop);
    }
    if (is_open) blend_while(std::false_type{}, kStop);
    blocks_[b] = block;
    blended_[b] += i;
    if (!any(block.transmittance >= kStop)) open_ &= ~(1u << b);
  }

  void unpack(int b, float (&planes)[6][kTile][kTile]) const {
    const Block& block = blocks_[b];
    const Mask never = block.transmittance >= 0.5f;
    const Floats values[6] = {block.red,
                              block.green,
                              block.blue,
                              block.depth,
                              select(never, 0.0f, block.median_depth),
                              Floats(1.0f) - block.transmittance};
    for (int k = 0; k < 6; ++k) {
      alignas(64) float pixels[kLanes];
      values[k].store(pixels);
      for (int row = 0; row < 4; ++row)
        std::memcpy(&planes[k][b / 4 * 4 + row][b % 4 * 4], pixels + 4 * row, 4 * sizeof(float));
    }
  }

  const int x_, y_;
  const View& view_;
  const Lanes lanes_;
  uint32_t open_ = 0;  // Blocks in the image with a pixel whose transmittance is at least kStop.
  Block blocks_[kBlocks];
  Splat batch_[kBatch];
  uint32_t blended_[kBlocks] = {};
};

}  // namespace ldo::LDO_ISA
