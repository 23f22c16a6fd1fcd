// Comparison of the surfaces of two calibration views.
#pragma once
#include <cstdint>

namespace ldo {

// Row of a block: point 0-2, unit normal 3-5. The normal is 0 0 0 where no surface is known.
constexpr int kSurfaceDoubles = 6;
// Derivatives of a residual: bias 0-2, times of the shutter 3-5 (readout of color, readout and
// delay of depth), rotation 6-8, translation 9-11; then the residual.
constexpr int kRowDoubles = 13;

struct SurfaceView {
  int64_t height, width;  // Blocks.
  double fx, fy, cx, cy;  // Intrinsics of the full image.
  double block;           // Side of a block, pixels.
};

// Motion of the camera during a view: it is at T_camera exp(velocity t) after the time t.
struct ViewMotion {
  const double* velocity;  // [6] rotation in rad/s, then translation in m/s.
  double readout_s;        // Time from the first to the last row of depth.
  double delay_s;          // Time from color to depth, middle rows.
};

// Comparison of each stride-th block along both axes. Features are compared without `here`,
// `basis`, `stride` and `max_step_ratio`.
struct Comparison {
  const double* there;         // [height width, 6]
  const double* here;          // [height width, 6]
  const double* basis;         // [height width, 3] of the depth bias.
  const double* T_here_there;  // [4, 4]
  ViewMotion motion_there, motion_here;
  int64_t stride;
  double max_step_ratio;
};

struct Compared {
  double* rows;      // [N, 13]
  double* depth_m;   // [N] depth of the moved point.
  int64_t* indices;  // [N, 2] blocks there and here.
};

// Camera and unknowns at which features are compared.
struct FeatureView {
  double width, height;   // Full image, pixels.
  double fx, fy, cx, cy;  // Intrinsics of the full image.
  int64_t block;          // Side of a block, pixels.
  int64_t rows, columns;  // Blocks.
  double bias[3];         // Coefficients of the depth bias, 1/m.
  double readout_s, depth_readout_s, delay_s;
};

struct Features {
  int64_t count;
  const double* pixels_there;  // [count, 2]
  const double* depth_there;   // [count] meters.
  const double* pixels_here;   // [count, 2]
};

// Camera and points whose reprojection is compared with measured pixels.
struct Reprojection {
  double fx, fy, cx, cy;
  const double* T;       // [4, 4] transform of the points into the camera.
  const double* points;  // [count, 3] meters.
  const double* pixels;  // [count, 2]
  int64_t count;
};

#define LDO_DECLARE(isa)                                                                         \
  namespace isa {                                                                                \
  void surfaces(const double* depth_m, const double* rays, int64_t height, int64_t width,        \
                double step_ratio, double step_m, double* result);                               \
  int64_t compare(const SurfaceView& view, const Comparison& input, Compared& result);           \
  void compare_features(const FeatureView& view, const Comparison& input,                        \
                        const Features& features, double* rows);                                 \
  void reproject(const Reprojection& input, double* errors, double* derivatives, double* moved); \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
