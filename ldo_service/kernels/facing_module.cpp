// Python binding of the angles between the normals of a region and its viewing rays. It checks the
// arguments and selects the instruction set.
#include "arrays.hpp"
#include "facing.hpp"
#include "isa.hpp"

namespace ldo {
namespace {

decltype(&baseline::facing_cosines) facing_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::facing_cosines;
  if (isa == Isa::avx2) return avx2::facing_cosines;
#endif
  (void)isa;
  return baseline::facing_cosines;
}

decltype(&baseline::facing_cosines) chosen = nullptr;  // Set when the module is imported.

int64_t facing_cosines(const Array& depth_m, const Array& ray_x, const Array& ray_y,
                       const Array& mask, const WritableArray& cosines) {
  require(depth_m.ndim() == 2 && depth_m.shape(0) >= 2 && depth_m.shape(1) >= 2,
          "depth_m must have shape [h, w] with sides of at least 2.");
  const size_t height = depth_m.shape(0), width = depth_m.shape(1);
  require_shape(ray_x, "ray_x", {width});
  require_shape(ray_y, "ray_y", {height});
  require_shape(mask, "mask", {height, width});
  require_shape(cosines, "cosines", {height * width});
  const FacingWindow window{static_cast<int64_t>(height),         static_cast<int64_t>(width),
                            values_of<float>(depth_m, "depth_m"), values_of<double>(ray_x, "ray_x"),
                            values_of<double>(ray_y, "ray_y"),    values_of<uint8_t>(mask, "mask")};
  double* out = values_of<double>(cosines, "cosines");
  nb::gil_scoped_release release;
  return chosen(window, out);
}

}  // namespace

NB_MODULE(_facing, m) {
  using namespace nb::literals;
  chosen = facing_for(chosen_isa());
  m.def("facing_cosines", &facing_cosines, "depth_m"_a, "ray_x"_a, "ray_y"_a, "mask"_a,
        "cosines"_a);
}

}  // namespace ldo
