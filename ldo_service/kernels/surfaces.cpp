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

constexpr double kMinIncidence = 0.2;      // Minimum |cosine| of a normal and a viewing ray.
constexpr double kMinInverseDepth = 0.02;  // 1/m, as in `correction.unbiased_depth`.
constexpr double kNearestDepth = 1e-6;     // Meters; nearer points are not projected.

// Errors [2] of a projected point, and their derivatives [2, 6] for exp(x) T, rotation first.
void project_point(double fx, double fy, double cx, double cy, const double* p, const double* pixel,
                   double* errors, double* derivatives) {
  const double inverse = 1 / (std::abs(p[2]) > kNearestDepth ? p[2] : kNearestDepth);
  const double a = p[0] * inverse, b = p[1] * inverse;
  errors[0] = fx * a + cx - pixel[0];
  errors[1] = fy * b + cy - pixel[1];
  const double by_u[6] = {-a * b, 1 + a * a, -b, inverse, 0, -a * inverse};
  const double by_v[6] = {-1 - b * b, a * b, a, 0, inverse, -b * inverse};
  for (int k = 0; k < 6; ++k) derivatives[k] = fx * by_u[k], derivatives[6 + k] = fy * by_v[k];
}

void transform(const double* T, const double* p, double* result) {
  for (int k = 0; k < 3; ++k) result[k] = dot(T + 4 * k, p) + T[4 * k + 3];
}

void turn(const double* T, const double* v, double* result) {
  for (int k = 0; k < 3; ++k) result[k] = dot(T + 4 * k, v);
}

// Rotate a vector by the rotation of the camera during a time, to first order.
void turn_during(const double* velocity, double time_s, const double* v, double* result) {
  double change[3];
  cross(velocity, v, change);
  for (int k = 0; k < 3; ++k) result[k] = v[k] + change[k] * time_s;
}

// Speed at which the depth of a fixed pixel decreases: that of the tangent plane of the surface, or
// 0 where no plane is known.
double depth_speed(const FeatureView& view, const Comparison& input, const double* pixel,
                   const double* ray, double depth_m) {
  const auto block_at = [&](double place, int64_t count) {
    const double index = std::floor((place + 0.5) / static_cast<double>(view.block));
    return static_cast<int64_t>(std::max(0.0, std::min(index, static_cast<double>(count - 1))));
  };
  const int64_t block =
      block_at(pixel[1], view.rows) * view.columns + block_at(pixel[0], view.columns);
  const double* n = input.there + kSurfaceDoubles * block + 3;
  const double incidence = dot(n, ray);
  if (!(std::abs(incidence) > kMinIncidence)) return 0;
  const double point[3] = {ray[0] * depth_m, ray[1] * depth_m, ray[2] * depth_m};
  double speed[3];
  speed_of(input.motion_there, point, speed);
  return dot(n, speed) / incidence;
}

// Write the two rows of a feature: the errors along u and v, with their derivatives.
void compare_feature(const FeatureView& view, const Comparison& input, const double* there,
                     double depth_there, const double* here, double* rows) {
  const double* T = input.T_here_there;
  const double row_there = there[1] / (view.height - 1) - 0.5;
  const double row_here = here[1] / (view.height - 1) - 0.5;
  const double ray[3] = {(there[0] - view.cx) / view.fx, (there[1] - view.cy) / view.fy, 1};
  const double x = (there[0] - (view.width - 1) / 2) / (view.width / 2);
  const double y = (there[1] - (view.height - 1) / 2) / (view.width / 2);
  const double basis[3] = {x * x, x * y, y * y};
  const double inverse = 1 / depth_there + dot(basis, view.bias);
  const double measured_m = 1 / std::max(inverse, kMinInverseDepth);
  // First, the depth is corrected to the time at which the color row of the first view was
  // recorded. The point is then moved to the time of the middle row, transformed to the second
  // view, and moved to the time of the color row in that view.
  const double z_per_s = depth_speed(view, input, there, ray, measured_m);
  const double after_color_s = view.delay_s + (view.depth_readout_s - view.readout_s) * row_there;
  const double z = measured_m + z_per_s * after_color_s;
  const double time_there = view.readout_s * row_there, time_here = view.readout_s * row_here;
  double point[3], speed_there[3], speed_here[3], at_middle[3], errors[2], by_point[12];
  for (int k = 0; k < 3; ++k) point[k] = ray[k] * z;
  speed_of(input.motion_there, point, speed_there);
  for (int k = 0; k < 3; ++k) point[k] += speed_there[k] * time_there;
  transform(T, point, at_middle);
  speed_of(input.motion_here, at_middle, speed_here);
  for (int k = 0; k < 3; ++k) at_middle[k] -= speed_here[k] * time_here;
  project_point(view.fx, view.fy, view.cx, view.cy, at_middle, here, errors, by_point);
  // Direction in which the point moves per unit of depth. The small rotations of the camera matter,
  // because a point that moves along its own ray keeps its pixel.
  double turned[3], across[3], along[3], turned_speed[3], by_times[3][3];
  turn_during(input.motion_there.velocity, time_there, ray, turned);
  turn(T, turned, across);
  turn_during(input.motion_here.velocity, -time_here, across, along);
  turn(T, speed_there, turned_speed);
  for (int k = 0; k < 3; ++k) {
    const double by_depth = along[k] * z_per_s, by_row = by_depth * row_there;
    by_times[0][k] = turned_speed[k] * row_there - speed_here[k] * row_here - by_row;
    by_times[1][k] = by_row;
    by_times[2][k] = by_depth;
  }
  for (int axis = 0; axis < 2; ++axis) {
    double* row = rows + kRowDoubles * axis;
    const double *derivatives = by_point + 6 * axis, *by_place = derivatives + 3;
    // The depth of a point on a ray changes by -z^2 per unit of the bias.
    const double by_bias = -dot(by_place, along) * (measured_m * measured_m);
    for (int k = 0; k < 3; ++k)
      row[k] = by_bias * basis[k], row[3 + k] = dot(by_place, by_times[k]);
    for (int k = 0; k < 6; ++k) row[6 + k] = derivatives[k];
    row[12] = errors[axis];
  }
}

}  // namespace

void compare_features(const FeatureView& view, const Comparison& input, const Features& features,
                      double* rows) {
  for (int64_t i = 0; i < features.count; ++i)
    compare_feature(view, input, features.pixels_there + 2 * i, features.depth_there[i],
                    features.pixels_here + 2 * i, rows + 2 * kRowDoubles * i);
}

void reproject(const Reprojection& input, double* errors, double* derivatives, double* moved) {
  for (int64_t i = 0; i < input.count; ++i) {
    double* p = moved + 3 * i;
    transform(input.T, input.points + 3 * i, p);
    project_point(input.fx, input.fy, input.cx, input.cy, p, input.pixels + 2 * i, errors + 2 * i,
                  derivatives + 12 * i);
  }
}

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
