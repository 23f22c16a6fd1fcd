// Ring of image rows for processing from top to bottom, and the inverse depth of an image in it.
#pragma once
#include <algorithm>

#include "buffer.hpp"
#include "simd.hpp"

namespace ldo::LDO_ISA {

// Return the row or column that `i` mirrors at the edge. The edge itself is not repeated.
inline int mirrored(int i, int size) {
  if (size == 1) return 0;
  while (i < 0 || i >= size) i = i < 0 ? -i : 2 * (size - 1) - i;
  return i;
}

// Return the number of floats of a row in memory: the pixels in whole vectors, and one more vector
// on each side. The first pixel lies at the start of a cache line.
inline int padded(int width) { return (width + kLanes - 1) / kLanes * kLanes + 2 * kLanes; }

// Write the mirrored values of `reach` pixels beyond both ends of a row.
inline void mirror_ends(float* row, int width, int reach) {
  for (int k = 1; k <= reach; ++k) {
    row[-k] = row[mirrored(-k, width)];
    row[width - 1 + k] = row[mirrored(width - 1 + k, width)];
  }
}

// Call f(column) for the first column of each vector of a row.
template <class F>
[[gnu::always_inline]] inline void each_vector(int width, F f) {
  for (int column = 0; column < width; column += kLanes) f(column);
}

// Ring buffer of the last five rows of a few images. Row numbers beyond the image are mirrored.
// Rows y - 2 to y + 2 are available once row y + 2, or the last row of the image, is written.
class RowsOfImages {
 public:
  RowsOfImages(int images, int width, int height)
      : stride_(padded(width)),
        height_(height),
        rows_(static_cast<size_t>(images) * kKept * stride_) {
    std::fill_n(rows_.data(), rows_.size(), 0.0f);
  }
  float* row(int image, int y) {
    return rows_.data() + (image * kKept + mirrored(y, height_) % kKept) * stride_ + kLanes;
  }

 private:
  static constexpr int kKept = 5;
  const int64_t stride_;
  const int height_;
  Buffer<float> rows_;
};

// Inverse depth row by row, 0 where depth is missing, and its minimum and maximum over 3x3 pixels.
class InverseDepth {
 public:
  // Create the inverse depth of a window of an image whose rows lie `stride` floats apart.
  InverseDepth(const float* depth_m, int64_t stride, int width, int height)
      : depth_m_(depth_m),
        stride_(stride),
        width_(width),
        height_(height),
        rows_(kImages, width, height) {}

  void load(int y) {
    const float* depth_m = depth_m_ + y * stride_;
    float *inverse = rows_.row(kInverse, y), *low = rows_.row(kLow, y), *high = rows_.row(kHigh, y);
    each_vector(width_, [&](int i) {
      const Floats z = Floats::load_first(depth_m + i, std::min(kLanes, width_ - i));
      select(Floats(0.0f) < z, Floats(1.0f) / max(z, kNearest), 0.0f).store(inverse + i);
    });
    mirror_ends(inverse, width_, 1);
    each_vector(width_, [&](int i) {
      const Neighbors at(inverse + i);
      min(min(at.at<-1>(), at.at<0>()), at.at<1>()).store(low + i);
      max(max(at.at<-1>(), at.at<0>()), at.at<1>()).store(high + i);
    });
  }

  const float* row(int y) { return rows_.row(kInverse, y); }

  // Call f(column, low, high) for each vector of row y. The row below, if there is one, must be
  // loaded.
  template <class F>
  void each_extreme(int y, F f) {
    const float *low[3], *high[3];
    for (int k = 0; k < 3; ++k) {
      low[k] = rows_.row(kLow, y + k - 1);
      high[k] = rows_.row(kHigh, y + k - 1);
    }
    each_vector(width_, [&](int i) {
      f(i, min(min(Floats::load(low[0] + i), Floats::load(low[1] + i)), Floats::load(low[2] + i)),
        max(max(Floats::load(high[0] + i), Floats::load(high[1] + i)), Floats::load(high[2] + i)));
    });
  }

 private:
  enum Image { kInverse, kLow, kHigh, kImages };
  static constexpr float kNearest = 1e-6f;  // Meters.

  const float* const depth_m_;
  const int64_t stride_;
  const int width_, height_;
  RowsOfImages rows_;
};

}  // namespace ldo::LDO_ISA
