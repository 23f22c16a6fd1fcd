// Comparison of the surfaces of two calibration views, compiled once per instruction set (LDO_ISA).
#include "surfaces.hpp"

#include <algorithm>
#include <cmath>

namespace ldo::LDO_ISA {
namespace {

double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

void cross(const double* a, const double* b, double* result) {
  result[0] = a[1] * b[2] - a[2] * b[1];
  result[1] = a[2] * b[0] - a[0] * b[2];
  result[2] = a[0] * b[1] - a[1] * b[0];
}

bool has_normal(const double* surface) {
  return surface[3] != 0 || surface[4] != 0 || surface[5] != 0;
}

// Index of the block that a point projects into, or -1.
int64_t block_of(const SurfaceView& view, const double* p) {
  constexpr double kNearestM = 0.1;
  if (!(p[2] > kNearestM)) return -1;
  const double column = std::floor((view.fx * p[0] / p[2] + view.cx + 0.5) / view.block);
  const double row = std::floor((view.fy * p[1] / p[2] + view.cy + 0.5) / view.block);
  const bool inside = column >= 0 && row >= 0 && column < static_cast<double>(view.width) &&
                      row < static_cast<double>(view.height);
  return inside ? static_cast<int64_t>(row) * view.width + static_cast<int64_t>(column) : -1;
}

// Velocity of a static point in the camera frame of a view, with the opposite sign.
void speed_of(const ViewMotion& motion, const double* point, double* result) {
  cross(motion.velocity, point, result);
  for (int i = 0; i < 3; ++i) result[i] += motion.velocity[3 + i];
}

// Time at which depth at the height v of the image is measured, after the middle of color. The row
// is 0 in the middle, and -0.5 and 0.5 at the ends.
double depth_time(const SurfaceView& view, const ViewMotion& motion, double v, double* row) {
  const double last = view.block * static_cast<double>(view.height) - 1;
  *row = std::clamp(v / last - 0.5, -0.5, 0.5);
  return motion.delay_s + motion.readout_s * *row;
}

// Write one row if the point there lies on a surface that the view here shows.
bool compare_block(const SurfaceView& view, const Comparison& input, int64_t a, double* row,
                   double* depth_m, int64_t* indices) {
  const double* there = input.there + kSurfaceDoubles * a;
  if (!has_normal(there)) return false;
  const double* T = input.T_here_there;
  // Move the point to the time of the first color image ("there"), transform it to the time of the
  // second one ("here"), and move it to the time at which the second depth is measured.
  double row_there, row_here, speed_there[3], speed_here[3], at_color[3], point[3];
  const double v_there = view.block * (static_cast<double>(a / view.width) + 0.5) - 0.5;
  const double time_there = depth_time(view, input.motion_there, v_there, &row_there);
  speed_of(input.motion_there, there, speed_there);
  for (int i = 0; i < 3; ++i) at_color[i] = there[i] + time_there * speed_there[i];
  for (int i = 0; i < 3; ++i) point[i] = dot(T + 4 * i, at_color) + T[4 * i + 3];
  if (!(point[2] > 0)) return false;
  const double v_here = view.fy * point[1] / point[2] + view.cy;
  const double time_here = depth_time(view, input.motion_here, v_here, &row_here);
  speed_of(input.motion_here, point, speed_here);
  for (int i = 0; i < 3; ++i) point[i] -= time_here * speed_here[i];
  const int64_t b = block_of(view, point);
  if (b < 0) return false;
  const double* here = input.here + kSurfaceDoubles * b;
  if (!has_normal(here)) return false;
  const double* n = here + 3;
  // Depth of the tangent plane here on the ray of the point.
  const double plane_m = point[2] * dot(here, n) / dot(point, n);
  if (!(std::abs(point[2] - plane_m) < input.max_step_ratio * point[2])) return false;
  // The derivatives are those at the mean depth of both measurements. The noise of either one
  // correlates with that of the residual, and the estimate would be biased.
  const double point_share = 0.5 * (point[2] + plane_m) / point[2];
  const double here_share = 0.5 * (point[2] + plane_m) / plane_m;
  double middle[3], before[3], apart[3], turned[3];
  for (int i = 0; i < 3; ++i) {
    middle[i] = point_share * point[i];
    before[i] = middle[i] - T[4 * i + 3];
    apart[i] = point[i] - here[i];
    turned[i] = dot(T + 4 * i, speed_there);
  }
  const double depth_there = T[2] * before[0] + T[6] * before[1] + T[10] * before[2];
  // A point on a ray moves by -z^2 ray = -z point per unit of the bias.
  const double slope_there = dot(before, n) * depth_there;
  const double slope_here = dot(here, n) * here[2] * here_share * here_share;
  const double moved_there = dot(turned, n), moved_here = dot(speed_here, n);
  row[3] = 0;
  row[4] = moved_there * row_there - moved_here * row_here;
  row[5] = moved_there - moved_here;
  for (int i = 0; i < 3; ++i) {
    row[i] = slope_here * input.basis[3 * b + i] - slope_there * input.basis[3 * a + i];
    row[9 + i] = n[i];
  }
  cross(middle, n, row + 6);
  row[12] = dot(apart, n);
  *depth_m = middle[2];
  indices[0] = a;
  indices[1] = b;
  return true;
}

}  // namespace

void surfaces(const double* depth_m, const double* rays, int64_t height, int64_t width,
              double step_ratio, double step_m, double* result) {
  for (int64_t a = 0; a < height * width; ++a) {
    double* s = result + kSurfaceDoubles * a;
    for (int i = 0; i < 3; ++i) s[i] = rays[3 * a + i] * depth_m[a];
    s[3] = s[4] = s[5] = 0;
  }
  for (int64_t row = 1; row < height - 1; ++row) {
    for (int64_t column = 1; column < width - 1; ++column) {
      const int64_t a = row * width + column, offsets[4] = {1, -1, width, -width};
      const double z = depth_m[a];
      bool near = z > 0;
      for (int64_t offset : offsets) {
        const double other = depth_m[a + offset];
        near = near && other > 0 && std::abs(other - z) < step_ratio * z + step_m;
      }
      if (!near) continue;
      double* s = result + kSurfaceDoubles * a;
      double right[3], down[3];
      for (int i = 0; i < 3; ++i) {
        right[i] = s[kSurfaceDoubles + i] - s[i - kSurfaceDoubles];
        down[i] = s[kSurfaceDoubles * width + i] - s[i - kSurfaceDoubles * width];
      }
      cross(right, down, s + 3);
      const double length = std::max(std::sqrt(dot(s + 3, s + 3)), 1e-12);
      for (int i = 3; i < 6; ++i) s[i] /= length;
    }
  }
}

int64_t compare(const SurfaceView& view, const Comparison& input, Compared& result) {
  int64_t count = 0;
  for (int64_t row = 0; row < view.height; row += input.stride)
    for (int64_t column = 0; column < view.width; column += input.stride)
      count +=
          compare_block(view, input, row * view.width + column, result.rows + kRowDoubles * count,
                        result.depth_m + count, result.indices + 2 * count);
  return count;
}

}  // namespace ldo::LDO_ISA
