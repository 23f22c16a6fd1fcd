// Python binding of the motion of Gaussians. It checks the arguments and selects the instruction
// set.
#include "arrays.hpp"
#include "isa.hpp"
#include "motion.hpp"

namespace ldo {
namespace {

decltype(&baseline::move_rows) move_rows_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::move_rows;
  if (isa == Isa::avx2) return avx2::move_rows;
#endif
  (void)isa;
  return baseline::move_rows;
}

decltype(&baseline::move_rows) chosen = nullptr;  // Set when the module is imported.

void move_rows(const WritableArray& rows, const Array& anchors, const Array& keyframes,
               const Array& T_new_old, const Array& quaternions, int threads) {
  require_threads(threads);
  require(rows.ndim() == 2 && rows.shape(1) == kMotionFloats, "rows must have shape [N, 16].");
  require(keyframes.ndim() == 1, "keyframes must have shape [K].");
  const size_t n = rows.shape(0), k = keyframes.shape(0);
  require_shape(anchors, "anchors", {n});
  require_shape(T_new_old, "T_new_old", {k, 4, 4});
  require_shape(quaternions, "quaternions", {k, 4});
  const int64_t* ids = values_of<int64_t>(keyframes, "keyframes");
  bool ascend = true;
  for (size_t i = 1; i < k; ++i) ascend = ascend && ids[i - 1] < ids[i];
  require(ascend, "keyframes must ascend.");
  const Motions motions{ids, values_of<double>(T_new_old, "T_new_old"),
                        values_of<double>(quaternions, "quaternions"), static_cast<int64_t>(k)};
  float* values = values_of<float>(rows, "rows");
  const int32_t* owners = values_of<int32_t>(anchors, "anchors");
  nb::gil_scoped_release release;
  chosen(values, owners, static_cast<int64_t>(n), motions, threads);
}

}  // namespace

NB_MODULE(_motion, m) {
  using namespace nb::literals;
  chosen = move_rows_for(chosen_isa());
  m.def("move_rows", &move_rows, "rows"_a, "anchors"_a, "keyframes"_a, "T_new_old"_a,
        "quaternions"_a, "threads"_a = 1);
}

}  // namespace ldo
