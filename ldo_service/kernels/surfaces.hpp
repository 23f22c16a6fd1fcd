// Comparison of the surfaces of two calibration views.
#pragma once
#include <cstdint>

namespace ldo {

// Row of a block: point 0-2, unit normal 3-5. The normal is 0 0 0 where no surface is known.
constexpr int kSurfaceDoubles = 6;
// Derivatives of a residual: bias 0-2, rotation 3-5, translation 6-8; then the residual.
constexpr int kRowDoubles = 10;

struct SurfaceView {
  int64_t height, width;  // Blocks.
  double fx, fy, cx, cy;  // Intrinsics of the full image.
  double block;           // Side of a block, pixels.
};

// Comparison of each stride-th block along both axes.
struct Comparison {
  const double* there;         // [height width, 6]
  const double* here;          // [height width, 6]
  const double* basis;         // [height width, 3] of the depth bias.
  const double* T_here_there;  // [4, 4]
  int64_t stride;
  double max_step_ratio;
};

struct Compared {
  double* rows;      // [N, 10]
  double* depth_m;   // [N] depth of the moved point.
  int64_t* indices;  // [N, 2] blocks there and here.
};

#define LDO_DECLARE(isa)                                                                  \
  namespace isa {                                                                         \
  void surfaces(const double* depth_m, const double* rays, int64_t height, int64_t width, \
                double step_ratio, double step_m, double* result);                        \
  int64_t compare(const SurfaceView& view, const Comparison& input, Compared& result);    \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
