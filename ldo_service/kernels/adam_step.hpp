// One step of Adam on one row.
//
// The step follows Kingma and Ba, Adam, 2015, algorithm 1, with one step count per row. A row whose
// gradient is zero keeps its values, moments and step count.
#pragma once
#include "adam.hpp"
#include "buffer.hpp"
#include "simd.hpp"

namespace ldo::LDO_ISA {

class AdamStep {
 public:
  AdamStep(const AdamRows& rows, const AdamRates& rates)
      : rows_(rows), rates_(rates), rate_(Floats::load(rates.rate)), corrections_(kCorrections) {
    double power1 = 1.0, power2 = 1.0;
    for (int step = 1; step < kCorrections; ++step) {
      power1 *= rates.beta1;
      power2 *= rates.beta2;
      corrections_[step] = {static_cast<float>(1.0 / (1.0 - power1)),
                            static_cast<float>(1.0 / (1.0 - power2))};
    }
  }

  // Update one row and return whether it changed. Only one thread at a time may process a row.
  bool operator()(uint32_t row, Floats gradient) const {
    if (!any(Floats(0.0f) < abs(gradient))) return false;  // The Gaussian is occluded.
    const int64_t at = static_cast<int64_t>(row) * kAdamFloats;
    const Correction& correction = corrections_[std::min(++rows_.steps[row], kCorrections - 1)];
    const Floats mean =
        Floats::load(rows_.mean + at) * rates_.beta1 + gradient * (1 - rates_.beta1);
    const Floats square =
        Floats::load(rows_.square + at) * rates_.beta2 + gradient * gradient * (1 - rates_.beta2);
    const Floats size = sqrt(square * correction.square) + rates_.epsilon;
    mean.store(rows_.mean + at);
    square.store(rows_.square + at);
    (Floats::load(rows_.parameters + at) - rate_ * correction.mean * mean / size)
        .store(rows_.parameters + at);
    return true;
  }

 private:
  // Number of steps after which 1 - beta^steps is 1 in practice.
  static constexpr int32_t kCorrections = 1024;
  struct Correction {
    float mean, square;  // Bias corrections 1 / (1 - beta^steps).
  };
  const AdamRows rows_;
  const AdamRates rates_;
  const Floats rate_;
  Buffer<Correction> corrections_;
};

}  // namespace ldo::LDO_ISA
