// Python binding of the Adam step. It checks the arguments and selects the instruction set.
#include "adam_arguments.hpp"
#include "isa.hpp"

namespace ldo {
namespace {

decltype(&baseline::adam_step) adam_step_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::adam_step;
  if (isa == Isa::avx2) return avx2::adam_step;
#endif
  (void)isa;
  return baseline::adam_step;
}

decltype(&baseline::adam_step) chosen = nullptr;  // Set when the module is imported.

void require_indices(const uint32_t* indices, size_t m, size_t n) {
  bool ascend = m == 0 || indices[m - 1] < n;
  for (size_t i = 1; i < m; ++i) ascend = ascend && indices[i - 1] < indices[i];
  require(ascend, "indices must ascend and be below the number of rows.");
}

void adam_step(const WritableArray& rows, const WritableArray& mean, const WritableArray& square,
               const WritableArray& steps, const Array& indices, const Array& gradients,
               const Array& rates, float beta1, float beta2, float epsilon, int threads) {
  require_threads(threads);
  const AdamRows state = adam_rows_of(rows, mean, square, steps);
  const AdamRates hyper = adam_rates_of(rates, beta1, beta2, epsilon);
  require(indices.ndim() == 1, "indices must have shape [M].");
  const size_t m = indices.shape(0);
  require_shape(gradients, "gradients", {m, kAdamFloats});
  const uint32_t* which = values_of<uint32_t>(indices, "indices");
  require_indices(which, m, rows.shape(0));
  const float* by_rows = values_of<float>(gradients, "gradients");
  nb::gil_scoped_release release;
  chosen(state, which, by_rows, m, hyper, threads);
}

}  // namespace

NB_MODULE(_adam, m) {
  using namespace nb::literals;
  chosen = adam_step_for(chosen_isa());
  m.def("adam_step", &adam_step, "rows"_a, "mean"_a, "square"_a, "steps"_a, "indices"_a,
        "gradients"_a, "rates"_a, "beta1"_a, "beta2"_a, "epsilon"_a, "threads"_a = 1);
}

}  // namespace ldo
