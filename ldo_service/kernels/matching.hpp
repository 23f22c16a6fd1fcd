// Nearest binary descriptors, by Hamming distance.
#pragma once
#include <cstdint>

namespace ldo {

constexpr int kDescriptorBytes = 32;

struct Nearest {
  int64_t* index;    // [N] index of the nearest candidate.
  int32_t* nearest;  // [N] its distance, bits.
  int32_t* second;   // [N] distance of the second nearest candidate, bits.
};

// Find the two nearest of `count` candidates for each of n descriptors of 32 bytes. Of candidates
// at equal distances, the one with the lowest index is the nearest. `count` is at least 2.
#define LDO_DECLARE(isa)                                                                        \
  namespace isa {                                                                               \
  void nearest(const uint8_t* descriptors, int64_t n, const uint8_t* candidates, int64_t count, \
               Nearest& result);                                                                \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
