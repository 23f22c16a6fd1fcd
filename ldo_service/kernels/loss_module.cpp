// Python binding of the loss. It checks the arguments and selects the instruction set.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <optional>
#include <tuple>

#include "arrays.hpp"
#include "isa.hpp"
#include "loss.hpp"

namespace ldo {
namespace {

decltype(&baseline::image_loss) image_loss_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::image_loss;
  if (isa == Isa::avx2) return avx2::image_loss;
#endif
  (void)isa;
  return baseline::image_loss;
}

decltype(&baseline::image_loss) chosen = nullptr;  // Set when the module is imported.

using Terms = std::tuple<double, double, double, double>;

Terms image_loss(const Array& planes, const Array& color, const Array& depth,
                 const std::optional<Array>& mask, const Array& exposure, float l1, float d_ssim,
                 float depth_weight, const WritableArray& gradients, int threads) {
  require_threads(threads);
  require(planes.ndim() == 3 && planes.shape(0) == 5 && planes.size() > 0,
          "planes must have shape [5, H, W].");
  const size_t height = planes.shape(1), width = planes.shape(2);
  require(height <= 32768 && width <= 32768, "an image may have at most 32768 pixels a side.");
  require_shape(color, "color", {3, height, width});
  require_shape(depth, "depth", {height, width});
  if (mask) require_shape(*mask, "mask", {height, width});
  require_shape(exposure, "exposure", {2, 3});
  require_shape(gradients, "gradients", {5, height, width});
  const LossInput in{static_cast<int>(width),
                     static_cast<int>(height),
                     values_of<float>(planes, "planes"),
                     values_of<uint8_t>(color, "color"),
                     values_of<float>(depth, "depth"),
                     mask ? values_of<uint8_t>(*mask, "mask") : nullptr,
                     values_of<float>(exposure, "exposure"),
                     {l1, d_ssim, depth_weight}};
  LossOutput out{};
  out.gradients = values_of<float>(gradients, "gradients");
  {
    nb::gil_scoped_release release;
    chosen(in, threads, out);
  }
  return {out.l1, out.d_ssim, out.depth, out.squared_error};
}

}  // namespace

NB_MODULE(_loss, m) {
  using namespace nb::literals;
  chosen = image_loss_for(chosen_isa());
  m.def("image_loss", &image_loss, "planes"_a, "color"_a, "depth"_a, "mask"_a.none(), "exposure"_a,
        "l1"_a, "d_ssim"_a, "depth_weight"_a, "gradients"_a, "threads"_a = 1);
}

}  // namespace ldo
