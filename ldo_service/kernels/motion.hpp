// Motion of Gaussians with their anchor keyframes.
#pragma once
#include <cstdint>

namespace ldo {

constexpr int kMotionFloats = 16;  // Row of a Gaussian: mean 0-2, rotation wxyz 6-9.

// Rigid motions of K keyframes, in ascending order of their ids.
struct Motions {
  const int64_t* keyframes;
  const double* T_new_old;   // [K, 4, 4]
  const double* quaternion;  // [K, 4] wxyz
  int64_t count;
};

#define LDO_DECLARE(isa)                                                                 \
  namespace isa {                                                                        \
  void move_rows(float* rows, const int32_t* anchors, int64_t n, const Motions& motions, \
                 int threads);                                                           \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
