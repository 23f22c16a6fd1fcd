// Python binding of surfaces and foregrounds. It checks arguments and selects the instruction set.
#include <algorithm>
#include <cmath>
#include <memory>

#include "arrays.hpp"
#include "foreground.hpp"
#include "isa.hpp"

namespace ldo {
namespace {

struct Kernels {
  decltype(&baseline::surfaces) surfaces;
  decltype(&baseline::foreground) foreground;
};

Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return {avx512::surfaces, avx512::foreground};
  if (isa == Isa::avx2) return {avx2::surfaces, avx2::foreground};
#endif
  (void)isa;
  return {baseline::surfaces, baseline::foreground};
}

Kernels kernels;  // Set when the module is imported.

constexpr double kMost = 1e6;  // Maximum of a fraction, far within the range of a float.

DepthImage image_of(const Array& depth_m) {
  require(depth_m.ndim() == 2 && depth_m.size() > 0, "depth_m must have shape [H, W].");
  const size_t height = depth_m.shape(0), width = depth_m.shape(1);
  require(height <= 32768 && width <= 32768, "an image may have at most 32768 pixels a side.");
  return {values_of<float>(depth_m, "depth_m"), static_cast<int>(width), static_cast<int>(height)};
}

// Return 1 + share as NumPy rounds it: the sum in double precision, the result in single.
float ratio_of(double share, const std::string& name) {
  require(share >= 0 && share <= kMost, name + " must lie in 0..1e6.");
  return static_cast<float>(1.0 + share);
}

using Sizes = nb::ndarray<nb::numpy, int64_t>;

Sizes surfaces(const Array& depth_m, double fx, double fy, double cx, double cy, double max_step,
               double min_cosine, const WritableArray& labels) {
  const DepthImage image = image_of(depth_m);
  require(std::isfinite(fx) && std::isfinite(fy) && std::isfinite(cx) && std::isfinite(cy) &&
              fx > 0 && fy > 0,
          "the camera must be finite, with positive focal lengths.");
  require(min_cosine >= 0 && min_cosine <= 1, "min_cosine must lie in 0..1.");
  const SurfaceRule rule{ratio_of(max_step, "max_step"), static_cast<float>(min_cosine)};
  require_shape(labels, "labels", {depth_m.shape(0), depth_m.shape(1)});
  int32_t* out = values_of<int32_t>(labels, "labels");
  std::unique_ptr<int64_t[]> sizes;
  size_t count;
  {
    nb::gil_scoped_release release;
    const std::vector<int64_t> of_labels = kernels.surfaces(image, {fx, fy, cx, cy}, rule, out);
    count = of_labels.size();
    sizes.reset(new int64_t[count]);
    std::copy(of_labels.begin(), of_labels.end(), sizes.get());
  }
  nb::capsule owner(sizes.get(), [](void* p) noexcept { delete[] static_cast<int64_t*>(p); });
  return Sizes(sizes.release(), {count}, owner);
}

void foreground(const Array& depth_m, double focal_px, const Array& labels, const Array& sizes,
                int row, int column, double min_inside, double max_gap, double depth_bin,
                double near_mode, int grow_px, const WritableArray& mask) {
  const DepthImage image = image_of(depth_m);
  require(std::isfinite(focal_px) && focal_px > 0, "focal_px must be finite and positive.");
  require_shape(labels, "labels", {depth_m.shape(0), depth_m.shape(1)});
  require(sizes.ndim() == 1, "sizes must have shape [S].");
  require(mask.ndim() == 2 && mask.size() > 0, "mask must have shape [h, w].");
  require(row >= 0 && column >= 0 && row + mask.shape(0) <= depth_m.shape(0) &&
              column + mask.shape(1) <= depth_m.shape(1),
          "mask must lie within the image.");
  const SurfaceLabels found{values_of<int32_t>(labels, "labels"),
                            values_of<int64_t>(sizes, "sizes"),
                            static_cast<int64_t>(sizes.shape(0))};
  const Window window{row, column, static_cast<int>(mask.shape(0)),
                      static_cast<int>(mask.shape(1))};
  require(min_inside >= 0 && min_inside <= 1, "min_inside must lie in 0..1.");
  require(depth_bin >= 1e-4 && depth_bin <= 1, "depth_bin must lie in 1e-4..1.");
  require(near_mode >= 0 && near_mode <= kMost && grow_px >= 0,
          "near_mode must lie in 0..1e6, grow_px must not be negative.");
  const ForegroundRule rule{min_inside, ratio_of(max_gap, "max_gap"), depth_bin, near_mode,
                            grow_px};
  uint8_t* out = values_of<uint8_t>(mask, "mask");
  bool is_known;
  {
    nb::gil_scoped_release release;
    is_known = kernels.foreground(image, focal_px, found, window, rule, out);
  }
  require(is_known, "each label must be at least 0 and below the length of sizes.");
}

}  // namespace

NB_MODULE(_foreground, m) {
  using namespace nb::literals;
  kernels = kernels_for(chosen_isa());
  m.def("surfaces", &surfaces, "depth_m"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a, "max_step"_a,
        "min_cosine"_a, "labels"_a);
  m.def("foreground", &foreground, "depth_m"_a, "focal_px"_a, "labels"_a, "sizes"_a, "row"_a,
        "column"_a, "min_inside"_a, "max_gap"_a, "depth_bin"_a, "near_mode"_a, "grow_px"_a,
        "mask"_a);
}

}  // namespace ldo
