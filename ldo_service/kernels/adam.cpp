// Compiled once per instruction set, LDO_ISA.
//
// Kingma and Ba, Adam, 2015, algorithm 1, with a step count per row: a row that no view reached
// neither moves nor ages.
#include "adam.hpp"

#include <cmath>

#include "buffer.hpp"
#include "parallel.hpp"
#include "simd.hpp"

namespace ldo::LDO_ISA {
namespace {

constexpr int64_t kJobRows = 4096;
constexpr int kCorrections = 1024;  // steps after which 1 - beta^steps is as good as 1

struct Correction {
  float mean, square;  // 1 / (1 - beta^steps)
};

Buffer<Correction> corrections(const AdamRates& rates) {
  Buffer<Correction> out(kCorrections);
  double power1 = 1.0, power2 = 1.0;
  for (int step = 1; step < kCorrections; ++step) {
    power1 *= rates.beta1;
    power2 *= rates.beta2;
    out[step] = {static_cast<float>(1.0 / (1.0 - power1)),
                 static_cast<float>(1.0 / (1.0 - power2))};
  }
  return out;
}

}  // namespace

void adam_step(AdamRows rows, const uint32_t* indices, const float* gradients, int64_t m,
               const AdamRates& rates, int threads) {
  const Buffer<Correction> correction = corrections(rates);
  const Floats rate = Floats::load(rates.rate);
  Team(threads).each((m + kJobRows - 1) / kJobRows, [&](int64_t job) {
    for (int64_t i = job * kJobRows; i < std::min(m, (job + 1) * kJobRows); ++i) {
      const Floats gradient = Floats::load(gradients + i * kAdamFloats);
      if (!any(Floats(0.0f) < abs(gradient))) continue;  // hidden behind others
      const int64_t at = static_cast<int64_t>(indices[i]) * kAdamFloats;
      const int32_t steps = std::min(++rows.steps[indices[i]], kCorrections - 1);
      const Floats mean = Floats::load(rows.mean + at) * rates.beta1 + gradient * (1 - rates.beta1);
      const Floats square =
          Floats::load(rows.square + at) * rates.beta2 + gradient * gradient * (1 - rates.beta2);
      const Floats size = sqrt(square * correction[steps].square) + rates.epsilon;
      const Floats step = rate * correction[steps].mean * mean / size;
      mean.store(rows.mean + at);
      square.store(rows.square + at);
      (Floats::load(rows.parameters + at) - step).store(rows.parameters + at);
    }
  });
}

}  // namespace ldo::LDO_ISA
