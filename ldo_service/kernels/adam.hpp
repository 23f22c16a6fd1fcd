// Interface of the Adam step on the rows visible in a view. It is independent of the instruction
// set.
#pragma once
#include <cstdint>

namespace ldo {

constexpr int kAdamFloats = 16;  // Floats per row.

struct AdamRates {
  float rate[kAdamFloats];  // Learning rate per field; 0 leaves the field unchanged.
  float beta1, beta2, epsilon;
};

struct AdamRows {  // N rows of 16 floats each.
  float* parameters;
  float* mean;     // Running mean of the gradient.
  float* square;   // Running mean of the squared gradient.
  int32_t* steps;  // [N], number of steps of each row.
};

#define LDO_DECLARE_ADAM(isa)                                                               \
  namespace isa {                                                                           \
  void adam_step(AdamRows rows, const uint32_t* indices, const float* gradients, int64_t m, \
                 const AdamRates& rates, int threads);                                      \
  }
LDO_DECLARE_ADAM(baseline)
LDO_DECLARE_ADAM(avx2)
LDO_DECLARE_ADAM(avx512)
#undef LDO_DECLARE_ADAM

}  // namespace ldo
