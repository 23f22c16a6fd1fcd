// Argument checks of the bindings that run Adam steps.
#pragma once
#include <cmath>

#include "adam.hpp"
#include "arrays.hpp"

namespace ldo {

inline AdamRows adam_rows_of(const WritableArray& rows, const WritableArray& mean,
                             const WritableArray& square, const WritableArray& steps) {
  require(rows.ndim() == 2 && rows.shape(1) == kAdamFloats, "rows must have shape [N, 16].");
  const size_t n = rows.shape(0);
  require_shape(mean, "mean", {n, kAdamFloats});
  require_shape(square, "square", {n, kAdamFloats});
  require_shape(steps, "steps", {n});
  return {values_of<float>(rows, "rows"), values_of<float>(mean, "mean"),
          values_of<float>(square, "square"), values_of<int32_t>(steps, "steps")};
}

inline AdamRates adam_rates_of(const Array& rates, float beta1, float beta2, float epsilon) {
  require_shape(rates, "rates", {kAdamFloats});
  require(beta1 >= 0 && beta1 < 1 && beta2 >= 0 && beta2 < 1, "beta1, beta2 must be in [0, 1).");
  require(epsilon > 0, "epsilon must be positive.");
  AdamRates out{{}, beta1, beta2, epsilon};
  const float* rate = values_of<float>(rates, "rates");
  for (int j = 0; j < kAdamFloats; ++j) {
    require(std::isfinite(rate[j]) && rate[j] >= 0, "rates must be finite and not negative.");
    out.rate[j] = rate[j];
  }
  return out;
}

}  // namespace ldo
