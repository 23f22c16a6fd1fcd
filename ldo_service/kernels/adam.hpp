// Adam on the rows that a view reached. Interface; no instruction set here.
#pragma once
#include <cstdint>

namespace ldo {

constexpr int kAdamFloats = 16;  // of one row

struct AdamRates {
  float rate[kAdamFloats];  // per field; 0 keeps it
  float beta1, beta2, epsilon;
};

struct AdamRows {  // N rows of 16 floats each
  float* parameters;
  float* mean;     // of the gradient
  float* square;   // mean of its square
  int32_t* steps;  // [N] that each row has made
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
