// Python binding of the comparison of calibration views. It checks the arguments and selects the
// instruction set.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <tuple>

#include "arrays.hpp"
#include "isa.hpp"
#include "surfaces.hpp"

namespace ldo {
namespace {

struct Kernels {
  decltype(&baseline::surfaces) surfaces;
  decltype(&baseline::compare) compare;
  decltype(&baseline::compare_features) compare_features;
  decltype(&baseline::reproject) reproject;
};

Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512)
    return {avx512::surfaces, avx512::compare, avx512::compare_features, avx512::reproject};
  if (isa == Isa::avx2)
    return {avx2::surfaces, avx2::compare, avx2::compare_features, avx2::reproject};
#endif
  (void)isa;
  return {baseline::surfaces, baseline::compare, baseline::compare_features, baseline::reproject};
}

Kernels chosen{};  // Set when the module is imported.

void require_positive(double value, const char* name) {
  require(std::isfinite(value) && value > 0, std::string(name) + " must be finite and positive.");
}

void surfaces(const Array& depth_m, const Array& rays, double step_ratio, double step_m,
              const WritableArray& result) {
  require(depth_m.ndim() == 2, "depth_m must have shape [h, w].");
  const size_t h = depth_m.shape(0), w = depth_m.shape(1);
  require_shape(rays, "rays", {h * w, 3});
  require(result.ndim() == 2 && result.shape(0) == h * w && result.shape(1) == kSurfaceDoubles,
          "result must have shape [h w, 6].");
  const double* z = values_of<double>(depth_m, "depth_m");
  const double* directions = values_of<double>(rays, "rays");
  double* values = values_of<double>(result, "result");
  nb::gil_scoped_release release;
  chosen.surfaces(z, directions, static_cast<int64_t>(h), static_cast<int64_t>(w), step_ratio,
                  step_m, values);
}

using Intrinsics = std::tuple<double, double, double, double>;
using DepthTimes = std::tuple<double, double>;  // Readout and delay, seconds.

int64_t compare(const Array& there, const Array& here, const Array& basis,
                const Array& T_here_there, const Array& velocity_there, const Array& velocity_here,
                const DepthTimes& times_s, const Intrinsics& intrinsics, int block, int width,
                int stride, double max_step_ratio, const WritableArray& rows,
                const WritableArray& depths, const WritableArray& indices) {
  require(there.ndim() == 2 && there.shape(1) == kSurfaceDoubles,
          "there must have shape [h w, 6].");
  const size_t size = there.shape(0);
  require_shape(here, "here", {size, kSurfaceDoubles});
  require_shape(basis, "basis", {size, 3});
  require_shape(T_here_there, "T_here_there", {4, 4});
  require_shape(velocity_there, "velocity_there", {6});
  require_shape(velocity_here, "velocity_here", {6});
  require(block >= 1 && stride >= 1, "block and stride must be at least 1.");
  require(width >= 1 && size % static_cast<size_t>(width) == 0, "width must divide the blocks.");
  const auto [fx, fy, cx, cy] = intrinsics;
  require_positive(fx, "fx");
  require_positive(fy, "fy");
  const SurfaceView view{static_cast<int64_t>(size) / width, width, fx, fy, cx, cy,
                         static_cast<double>(block)};
  const auto compared = [stride](int64_t side) {
    return static_cast<size_t>((side + stride - 1) / stride);
  };
  const size_t n = compared(view.height) * compared(view.width);
  require(rows.ndim() == 2 && rows.shape(0) >= n && rows.shape(1) == kRowDoubles,
          "rows must have shape [N, 13], with a row for each compared block.");
  require(depths.ndim() == 1 && depths.shape(0) >= n, "depths must have as many rows as rows.");
  require(indices.ndim() == 2 && indices.shape(0) >= n && indices.shape(1) == 2,
          "indices must have shape [N, 2], with as many rows as rows.");
  const auto [readout_s, delay_s] = times_s;
  const Comparison input{values_of<double>(there, "there"),
                         values_of<double>(here, "here"),
                         values_of<double>(basis, "basis"),
                         values_of<double>(T_here_there, "T_here_there"),
                         {values_of<double>(velocity_there, "velocity_there"), readout_s, delay_s},
                         {values_of<double>(velocity_here, "velocity_here"), readout_s, delay_s},
                         stride,
                         max_step_ratio};
  Compared result{values_of<double>(rows, "rows"), values_of<double>(depths, "depths"),
                  values_of<int64_t>(indices, "indices")};
  nb::gil_scoped_release release;
  return chosen.compare(view, input, result);
}

using Coefficients = std::tuple<double, double, double>;
using Times = std::tuple<double, double, double>;  // Readouts of color and depth, and delay.
using Size = std::tuple<int, int>;

void compare_features(const Array& there, const Array& pixels_there, const Array& depth_there,
                      const Array& pixels_here, const Array& T_here_there,
                      const Array& velocity_there, const Array& velocity_here,
                      const Coefficients& bias, const Times& times_s, const Intrinsics& intrinsics,
                      const Size& size, int block, const WritableArray& rows) {
  const auto [width, height] = size;
  require(block >= 1 && width >= block && height >= std::max(block, 2),
          "block must be at least 1, and the image at least as large as a block.");
  const auto [fx, fy, cx, cy] = intrinsics;
  require_positive(fx, "fx");
  require_positive(fy, "fy");
  const int64_t across = width / block, down = height / block;
  require_shape(there, "there", {static_cast<size_t>(across * down), kSurfaceDoubles});
  require(depth_there.ndim() == 1, "depth_there must have shape [M].");
  const size_t count = depth_there.shape(0);
  require_shape(pixels_there, "pixels_there", {count, 2});
  require_shape(pixels_here, "pixels_here", {count, 2});
  require_shape(T_here_there, "T_here_there", {4, 4});
  require_shape(velocity_there, "velocity_there", {6});
  require_shape(velocity_here, "velocity_here", {6});
  require_shape(rows, "rows", {2 * count, kRowDoubles});
  const auto [b1, b2, b3] = bias;
  const auto [readout_s, depth_readout_s, delay_s] = times_s;
  const FeatureView view{static_cast<double>(width),
                         static_cast<double>(height),
                         fx,
                         fy,
                         cx,
                         cy,
                         block,
                         down,
                         across,
                         {b1, b2, b3},
                         readout_s,
                         depth_readout_s,
                         delay_s};
  Comparison input{};
  input.there = values_of<double>(there, "there");
  input.T_here_there = values_of<double>(T_here_there, "T_here_there");
  input.motion_there.velocity = values_of<double>(velocity_there, "velocity_there");
  input.motion_here.velocity = values_of<double>(velocity_here, "velocity_here");
  const Features features{
      static_cast<int64_t>(count), values_of<double>(pixels_there, "pixels_there"),
      values_of<double>(depth_there, "depth_there"), values_of<double>(pixels_here, "pixels_here")};
  double* written = values_of<double>(rows, "rows");
  nb::gil_scoped_release release;
  chosen.compare_features(view, input, features, written);
}

void reproject(const Array& points, const Array& pixels, const Array& T,
               const Intrinsics& intrinsics, const WritableArray& errors,
               const WritableArray& derivatives, const WritableArray& moved) {
  require(points.ndim() == 2 && points.shape(1) == 3, "points must have shape [N, 3].");
  const size_t count = points.shape(0);
  require_shape(pixels, "pixels", {count, 2});
  require_shape(T, "T", {4, 4});
  require_shape(errors, "errors", {count, 2});
  require_shape(derivatives, "derivatives", {count, 2, 6});
  require_shape(moved, "moved", {count, 3});
  const auto [fx, fy, cx, cy] = intrinsics;
  const Reprojection input{fx,
                           fy,
                           cx,
                           cy,
                           values_of<double>(T, "T"),
                           values_of<double>(points, "points"),
                           values_of<double>(pixels, "pixels"),
                           static_cast<int64_t>(count)};
  double *e = values_of<double>(errors, "errors"), *p = values_of<double>(moved, "moved");
  double* J = values_of<double>(derivatives, "derivatives");
  nb::gil_scoped_release release;
  chosen.reproject(input, e, J, p);
}

}  // namespace

NB_MODULE(_surfaces, m) {
  using namespace nb::literals;
  chosen = kernels_for(chosen_isa());
  m.def("surfaces", &surfaces, "depth_m"_a, "rays"_a, "step_ratio"_a, "step_m"_a, "result"_a);
  m.def("compare", &compare, "there"_a, "here"_a, "basis"_a, "T_here_there"_a, "velocity_there"_a,
        "velocity_here"_a, "times_s"_a, "intrinsics"_a, "block"_a, "width"_a, "stride"_a,
        "max_step_ratio"_a, "rows"_a, "depths"_a, "indices"_a);
  m.def("compare_features", &compare_features, "there"_a, "pixels_there"_a, "depth_there"_a,
        "pixels_here"_a, "T_here_there"_a, "velocity_there"_a, "velocity_here"_a, "bias"_a,
        "times_s"_a, "intrinsics"_a, "size"_a, "block"_a, "rows"_a);
  m.def("reproject", &reproject, "points"_a, "pixels"_a, "T"_a, "intrinsics"_a, "errors"_a,
        "derivatives"_a, "moved"_a);
}

}  // namespace ldo
