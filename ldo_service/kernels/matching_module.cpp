// Python binding of the search for nearest descriptors. It checks the arguments and selects the
// instruction set.
#include "arrays.hpp"
#include "isa.hpp"
#include "matching.hpp"

namespace ldo {
namespace {

decltype(&baseline::nearest) nearest_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::nearest;
  if (isa == Isa::avx2) return avx2::nearest;
#endif
  (void)isa;
  return baseline::nearest;
}

decltype(&baseline::nearest) chosen = nullptr;  // Set when the module is imported.

const uint8_t* descriptors_of(const Array& array, const std::string& name) {
  require(array.ndim() == 2 && array.shape(1) == kDescriptorBytes,
          name + " must have shape [N, 32].");
  return values_of<uint8_t>(array, name);
}

void nearest(const Array& descriptors, const Array& candidates, const WritableArray& index,
             const WritableArray& least, const WritableArray& second) {
  const uint8_t* wanted = descriptors_of(descriptors, "descriptors");
  const uint8_t* others = descriptors_of(candidates, "candidates");
  const size_t n = descriptors.shape(0), count = candidates.shape(0);
  require(count >= 2, "candidates must have at least 2 rows.");
  require_shape(index, "index", {n});
  require_shape(least, "least", {n});
  require_shape(second, "second", {n});
  Nearest result{values_of<int64_t>(index, "index"), values_of<int32_t>(least, "least"),
                 values_of<int32_t>(second, "second")};
  nb::gil_scoped_release release;
  chosen(wanted, static_cast<int64_t>(n), others, static_cast<int64_t>(count), result);
}

}  // namespace

NB_MODULE(_matching, m) {
  using namespace nb::literals;
  chosen = nearest_for(chosen_isa());
  m.def("nearest", &nearest, "descriptors"_a, "candidates"_a, "index"_a, "least"_a, "second"_a);
}

}  // namespace ldo
