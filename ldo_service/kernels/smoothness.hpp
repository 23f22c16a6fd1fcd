// Smooth pixels of a depth image, which have no depth step and no crease around them.
#pragma once
#include "components.hpp"
#include "foreground.hpp"
#include "inverse_depth.hpp"

namespace ldo::LDO_ISA {

// Weights of the blur of inverse depth before normals are computed, exp(-k^2 / (2 1.5^2)) / sum for
// k = 0, 1, 2. With the blur, 58 % of a Kinect's pixels lie in surfaces smaller than 200 px;
// without the blur, 78 % do. A sigma of 2 px instead of 1.5 px lowers the mIoU of the objects by
// 1.3 percentage points on frames of a Replica apartment.
constexpr float kBlur[3] = {0.29208172f, 0.23388074f, 0.12007839f};
constexpr double kSobel = 128.0;  // Response of the 5x5 operator to a slope of 1.
constexpr int kApart = 2;         // Distance from a pixel to either of two normals, px.
// Minimum squared length of a normal, before it has unit length.
constexpr float kLeastSquare = 1e-9f * 1e-9f;

// Detection of smooth pixels in one pass down the image. Its steps exchange a few rows, which stay
// in the cache.
class Smoothness {
 public:
  Smoothness(const DepthImage& image, const Pinhole& camera, const SurfaceRule& rule)
      : image_(image),
        camera_(camera),
        rule_(rule),
        inverse_(image.depth_m, image.width, image.width, image.height),
        rows_(kImages, image.width, image.height),
        blurred_down_(padded(image.width)),
        ray_x_(padded(image.width)) {
    std::fill_n(blurred_down_.data(), blurred_down_.size(), 0.0f);
    std::fill_n(ray_x_.data(), ray_x_.size(), 0.0f);
    for (int u = 0; u < image.width; ++u)
      ray_x_[kLanes + u] = static_cast<float>((u - camera.cx) / camera.fx);
  }

  BitImage pixels() {
    BitImage out(image_.width, image_.height);
    for (int y = 0; y < image_.height + 6; ++y) {
      if (is_row(y)) inverse_.load(y);
      if (is_row(y - 1)) find_steps(y - 1, out);
      if (is_row(y - 2)) blur(y - 2);
      if (is_row(y - 4)) find_normals(y - 4), find_creases_across(y - 4, out);
      if (is_row(y - 6)) find_creases_down(y - 6, out);
    }
    return out;
  }

 private:
  // kAlong is the slope along the row, kMean the weighted mean along the row. The vertical parts of
  // the two 5x5 operators are applied later.
  enum Image { kBlurred, kAlong, kMean, kNormalX, kNormalY, kNormalZ, kSquare, kImages };

  bool is_row(int y) const { return y >= 0 && y < image_.height; }

  // Pointers to the rows y - 2 to y + 2, so that each row is looked up only once.
  struct Five {
    template <class Row>
    explicit Five(const Row& row_of, int y) {
      for (int k = -2; k <= 2; ++k) row[k + 2] = row_of(y + k);
    }
    template <int Below>
    [[gnu::always_inline]] inline Floats at(int column) const {
      return Floats::load(row[2 + Below] + column);
    }
    const float* row[5];
  };
  Five five(Image image, int y) {
    return Five([&](int k) { return rows_.row(image, k); }, y);
  }

  void find_steps(int y, BitImage& out) {
    inverse_.each_extreme(y, [&](int i, Floats low, Floats high) {
      out.set(y, i, bits((Floats(0.0f) < low) & (high < low * rule_.max_ratio)));
    });
  }

  void blur(int y) {
    const Five inverse([&](int k) { return inverse_.row(k); }, y);
    float *down = blurred_down_.data() + kLanes, *blurred = rows_.row(kBlurred, y);
    each_vector(image_.width, [&](int i) {
      (inverse.at<0>(i) * kBlur[0] + (inverse.at<-1>(i) + inverse.at<1>(i)) * kBlur[1] +
       (inverse.at<-2>(i) + inverse.at<2>(i)) * kBlur[2])
          .store(down + i);
    });
    mirror_ends(down, image_.width, 2);
    each_vector(image_.width, [&](int i) {
      const Neighbors at(down + i);
      (at.at<0>() * kBlur[0] + (at.at<-1>() + at.at<1>()) * kBlur[1] +
       (at.at<-2>() + at.at<2>()) * kBlur[2])
          .store(blurred + i);
    });
    mirror_ends(blurred, image_.width, 2);
    float *along = rows_.row(kAlong, y), *mean = rows_.row(kMean, y);
    each_vector(image_.width, [&](int i) {
      const Neighbors at(blurred + i);
      (at.at<2>() - at.at<-2>() + (at.at<1>() - at.at<-1>()) * 2.0f).store(along + i);
      (at.at<2>() + at.at<-2>() + (at.at<1>() + at.at<-1>()) * 4.0f + at.at<0>() * 6.0f)
          .store(mean + i);
    });
  }

  // Compute the normal of the plane n . p = d through the 5x5 pixels around each pixel of a row,
  // from 1 / z = n . ray / d. The normals are not scaled to unit length.
  void find_normals(int y) {
    const Five along = five(kAlong, y), mean = five(kMean, y);
    const float per_x = static_cast<float>(camera_.fx / kSobel),
                per_y = static_cast<float>(camera_.fy / kSobel),
                ray_y = static_cast<float>((y - camera_.cy) / camera_.fy);
    const float* blurred = rows_.row(kBlurred, y);
    float *out_x = rows_.row(kNormalX, y), *out_y = rows_.row(kNormalY, y),
          *out_z = rows_.row(kNormalZ, y), *square = rows_.row(kSquare, y);
    each_vector(image_.width, [&](int i) {
      const Floats n_x = (along.at<-2>(i) + along.at<2>(i) +
                          (along.at<-1>(i) + along.at<1>(i)) * 4.0f + along.at<0>(i) * 6.0f) *
                         per_x;
      const Floats n_y =
          (mean.at<2>(i) - mean.at<-2>(i) + (mean.at<1>(i) - mean.at<-1>(i)) * 2.0f) * per_y;
      const Floats ray_x = Floats::load(ray_x_.data() + kLanes + i);
      const Floats n_z = Floats::load(blurred + i) - n_x * ray_x - n_y * ray_y;
      n_x.store(out_x + i);
      n_y.store(out_y + i);
      n_z.store(out_z + i);
      max(n_x * n_x + n_y * n_y + n_z * n_z, kLeastSquare).store(square + i);
    });
  }

  struct Normals {  // Normals of a row.
    const float *x, *y, *z, *square;
  };
  Normals normals(int y) {
    return {rows_.row(kNormalX, y), rows_.row(kNormalY, y), rows_.row(kNormalZ, y),
            rows_.row(kSquare, y)};
  }

  // Compare sixteen normals of row `a` from column i with those of row `b` from column j. Return
  // the bits of the pairs whose cosine exceeds min_cosine. Squares are compared, because the
  // normals do not have unit length.
  uint32_t are_alike(const Normals& a, int i, const Normals& b, int j) const {
    const auto product = [&](const float* p, const float* q) {
      return Floats::load(p + i) * Floats::load(q + j);
    };
    const Floats dot = product(a.x, b.x) + product(a.y, b.y) + product(a.z, b.z);
    const Floats least = product(a.square, b.square) * (rule_.min_cosine * rule_.min_cosine);
    return bits((Floats(0.0f) < dot) & (least < dot * dot));
  }

  void find_creases_across(int y, BitImage& out) {
    const Normals row = normals(y);
    each_vector(image_.width, [&](int i) {
      const uint32_t judged = BitImage::within(i, kApart, image_.width - kApart);
      out.clear_others(y, i, are_alike(row, i - kApart, row, i + kApart) | ~judged);
    });
  }

  void find_creases_down(int y, BitImage& out) {
    if (y < kApart || y >= image_.height - kApart) return;
    const Normals above = normals(y - kApart), below = normals(y + kApart);
    each_vector(image_.width,
                [&](int i) { out.clear_others(y, i, are_alike(above, i, below, i)); });
  }

  const DepthImage& image_;
  const Pinhole& camera_;
  const SurfaceRule rule_;
  InverseDepth inverse_;
  RowsOfImages rows_;
  Buffer<float> blurred_down_, ray_x_;  // One more vector lies on each side.
};

}  // namespace ldo::LDO_ISA
