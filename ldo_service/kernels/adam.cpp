// Adam step on the rows visible in a view, compiled once per instruction set (macro LDO_ISA).
#include "adam_step.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {

void adam_step(AdamRows rows, const uint32_t* indices, const float* gradients, int64_t m,
               const AdamRates& rates, int threads) {
  constexpr int64_t kJobRows = 4096;
  const AdamStep step(rows, rates);
  Team(threads).each((m + kJobRows - 1) / kJobRows, [&](int64_t job) {
    for (int64_t i = job * kJobRows; i < std::min(m, (job + 1) * kJobRows); ++i)
      step(indices[i], Floats::load(gradients + i * kAdamFloats));
  });
}

}  // namespace ldo::LDO_ISA
