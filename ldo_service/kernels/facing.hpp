// Angles between the normals of a region and its viewing rays.
#pragma once
#include <cstdint>

namespace ldo {

// Window of h x w pixels around a region. The ray of pixel (i, j) is (ray_x[j], ray_y[i], 1).
struct FacingWindow {
  int64_t height, width;
  const float* depth_m;  // [h, w] depth, meters; 0 where unknown.
  const double* ray_x;   // [w]
  const double* ray_y;   // [h]
  const uint8_t* mask;   // [h, w] 1 at the pixels of the region.
};

// Write the absolute cosine between normal and ray of each pixel of the region that has a depth and
// a normal, row by row. The normal is the cross product of the central differences of the points
// along the columns and along the rows, one-sided at the border of the window. Return the number of
// cosines, at most h * w. The sides of the window are at least 2.
#define LDO_DECLARE(isa)                                               \
  namespace isa {                                                      \
  int64_t facing_cosines(const FacingWindow& window, double* cosines); \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
