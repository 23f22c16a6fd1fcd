// Angles between the normals of a region and its viewing rays, compiled once per instruction set
// (LDO_ISA), without fused operations.
#include "facing.hpp"

#include <algorithm>
#include <cmath>
#include <vector>

namespace ldo::LDO_ISA {
namespace {

// Three rows of a window: the row itself and those that its differences along the columns use.
struct Rows {
  const float *here, *up, *down;
  double ray_y, ray_y_up, ray_y_down;
  double scale;  // Factor of a difference between the rows `up` and `down`.
};

// Return the absolute cosine at column j. The differences along the row are those between the
// columns `left` and `right`, times `scale`. Write the product of the lengths of normal and ray.
inline double cosine(const Rows& rows, const double* ray_x, int64_t j, int64_t left, int64_t right,
                     double scale, double& lengths) {
  const double z_left = rows.here[left], z_right = rows.here[right];
  const double z_up = rows.up[j], z_down = rows.down[j], x = ray_x[j], y = rows.ray_y;
  const double x_u = (ray_x[right] * z_right - ray_x[left] * z_left) * scale;
  const double y_u = (y * z_right - y * z_left) * scale;
  const double z_u = (z_right - z_left) * scale;
  const double x_v = (x * z_down - x * z_up) * rows.scale;
  const double y_v = (rows.ray_y_down * z_down - rows.ray_y_up * z_up) * rows.scale;
  const double z_v = (z_down - z_up) * rows.scale;
  const double n_x = y_u * z_v - z_u * y_v;
  const double n_y = z_u * x_v - x_u * z_v;
  const double n_z = x_u * y_v - y_u * x_v;
  lengths = std::sqrt(n_x * n_x + n_y * n_y + n_z * n_z) * std::sqrt(x * x + y * y + 1.0);
  return std::fabs(n_x * x + n_y * y + n_z) / lengths;
}

}  // namespace

int64_t facing_cosines(const FacingWindow& window, double* cosines) {
  const int64_t height = window.height, width = window.width;
  std::vector<double> of_row(width), lengths(width);
  int64_t count = 0;
  for (int64_t i = 0; i < height; ++i) {
    const int64_t up = std::max<int64_t>(i - 1, 0), down = std::min(i + 1, height - 1);
    const Rows rows{window.depth_m + i * width,
                    window.depth_m + up * width,
                    window.depth_m + down * width,
                    window.ray_y[i],
                    window.ray_y[up],
                    window.ray_y[down],
                    down - up == 2 ? 0.5 : 1.0};
    const double* ray_x = window.ray_x;
    of_row[0] = cosine(rows, ray_x, 0, 0, 1, 1.0, lengths[0]);
    for (int64_t j = 1; j < width - 1; ++j)
      of_row[j] = cosine(rows, ray_x, j, j - 1, j + 1, 0.5, lengths[j]);
    of_row[width - 1] =
        cosine(rows, ray_x, width - 1, width - 2, width - 1, 1.0, lengths[width - 1]);
    const uint8_t* mask = window.mask + i * width;
    for (int64_t j = 0; j < width; ++j)
      if (mask[j] && rows.here[j] > 0 && lengths[j] > 0) cosines[count++] = of_row[j];
  }
  return count;
}

}  // namespace ldo::LDO_ISA
