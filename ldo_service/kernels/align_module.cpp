// Python binding of the alignment kernels (ldo_service.kernels._align). It checks every argument.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <optional>
#include <string>
#include <tuple>

#include "align.hpp"
#include "isa.hpp"

namespace nb = nanobind;
using namespace ldo::align;

namespace {

template <int Dimensions>
using Input = nb::ndarray<const float, nb::ndim<Dimensions>, nb::c_contig, nb::device::cpu>;
using Gray = nb::ndarray<const std::uint8_t, nb::ndim<2>, nb::c_contig, nb::device::cpu>;
using Output = nb::ndarray<nb::numpy, float>;
using Cells = nb::ndarray<const std::uint8_t, nb::ndim<1>, nb::c_contig, nb::device::cpu>;
using Pose = nb::ndarray<const double, nb::shape<4, 4>, nb::c_contig, nb::device::cpu>;
using Intrinsics = std::tuple<double, double, double, double>;

const Kernels& kernels(ldo::Isa isa) {
#if LDO_X86
  if (isa == ldo::Isa::avx512) return avx512();
  if (isa == ldo::Isa::avx2) return avx2();
#endif
  (void)isa;
  return baseline();
}

const Kernels* chosen = nullptr;  // Set when the module is imported.

void require(bool condition, const std::string& message) {
  if (!condition) throw nb::value_error(message.c_str());
}

std::string sizes(std::size_t height, std::size_t width) {
  return std::to_string(height) + "x" + std::to_string(width);
}

void require_image(std::size_t height, std::size_t width) {
  require(height >= 2 && width >= 2,
          "an image must have at least 2x2 pixels, not " + sizes(height, width));
  require(height <= 32768 && width <= 32768,
          "an image may have at most 32768 pixels a side, not " + sizes(height, width));
}

template <typename A, typename B>
void require_same_size(const A& a, const B& b) {
  require(a.shape(0) == b.shape(0) && a.shape(1) == b.shape(1),
          "images differ in size: " + sizes(a.shape(0), a.shape(1)) + " and " +
              sizes(b.shape(0), b.shape(1)));
}

Pinhole pinhole(const Intrinsics& intrinsics) {
  const auto [fx, fy, cx, cy] = intrinsics;
  require(std::isfinite(fx) && std::isfinite(fy) && fx > 0 && fy > 0 && std::isfinite(cx) &&
              std::isfinite(cy),
          "intrinsics (fx, fy, cx, cy) must be finite, focal lengths positive");
  return {static_cast<float>(fx), static_cast<float>(fy), static_cast<float>(cx),
          static_cast<float>(cy)};
}

float positive(double value, const char* name) {
  const float single = static_cast<float>(value);
  require(std::isfinite(single) && single > 0, std::string(name) + " must be finite and positive");
  return single;
}

float finite(double value, const char* name) {
  const float single = static_cast<float>(value);
  require(std::isfinite(single), std::string(name) + " must be finite");
  return single;
}

template <typename T>
nb::ndarray<nb::numpy, T> owned(std::unique_ptr<T[]> data,
                                std::initializer_list<std::size_t> shape) {
  T* raw = data.release();
  nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return nb::ndarray<nb::numpy, T>(raw, shape, owner);
}

std::unique_ptr<float[]> floats(std::size_t n) { return std::unique_ptr<float[]>(new float[n]); }

Output halve(Input<2> values, double tolerance, int least) {
  const std::size_t h = values.shape(0), w = values.shape(1);
  require_image(h, w);
  const float relative = positive(tolerance, "tolerance");
  if (least < 1 || least > 4) throw nb::value_error("least must be within 1..4");
  auto out = floats((h / 2) * (w / 2));
  {
    nb::gil_scoped_release release;
    chosen->halve(values.data(), static_cast<int>(w), static_cast<int>(h), relative, least,
                  out.get());
  }
  return owned(std::move(out), {h / 2, w / 2});
}

Output halve_gray(Gray gray, int clipped, int least) {
  const std::size_t h = gray.shape(0), w = gray.shape(1);
  require_image(h, w);
  if (least < 1 || least > 4) throw nb::value_error("least must be within 1..4");
  auto out = floats((h / 2) * (w / 2));
  {
    nb::gil_scoped_release release;
    chosen->halve_gray(gray.data(), static_cast<int>(w), static_cast<int>(h), clipped, least,
                       out.get());
  }
  return owned(std::move(out), {h / 2, w / 2});
}

Output pack(Input<2> image, Input<2> depth, double max_depth_m) {
  const std::size_t h = image.shape(0), w = image.shape(1);
  require_image(h, w);
  require_same_size(image, depth);
  const float max_depth = positive(max_depth_m, "max_depth_m");
  auto out = floats(h * w * kTexelSize);
  {
    nb::gil_scoped_release release;
    chosen->pack(image.data(), depth.data(), static_cast<int>(w), static_cast<int>(h), max_depth,
                 out.get());
  }
  return owned(std::move(out), {h, w, kTexelSize});
}

Output normals(Input<2> depth, const Intrinsics& intrinsics, int radius) {
  const std::size_t h = depth.shape(0), w = depth.shape(1);
  require_image(h, w);
  require(radius >= 1, "radius must be at least 1 pixel");
  const Pinhole camera = pinhole(intrinsics);
  auto out = floats(h * w * 3);
  {
    nb::gil_scoped_release release;
    chosen->normals(depth.data(), static_cast<int>(w), static_cast<int>(h), camera, radius,
                    out.get());
  }
  return owned(std::move(out), {h, w, 3});
}

void require_texels(const Input<3>& texels) {
  require_image(texels.shape(0), texels.shape(1));
  require(texels.shape(2) == kTexelSize, "texels must be [H, W, 4], as pack() returns them");
}

Output points(Input<3> texels, Input<3> normals, const Intrinsics& intrinsics) {
  require_texels(texels);
  require_same_size(texels, normals);
  require(normals.shape(2) == 3, "normals must be [H, W, 3]");
  const std::size_t h = texels.shape(0), w = texels.shape(1), capacity = h * w;
  const Pinhole camera = pinhole(intrinsics);
  std::unique_ptr<float[]> out;
  std::size_t n;
  {
    nb::gil_scoped_release release;
    auto all = floats(kPointRows * capacity);
    n = static_cast<std::size_t>(chosen->points(texels.data(), normals.data(), static_cast<int>(w),
                                                static_cast<int>(h), camera,
                                                static_cast<std::int64_t>(capacity), all.get()));
    out = floats(kPointRows * n);
    for (std::size_t k = 0; k < kPointRows; ++k)
      std::copy_n(all.get() + k * capacity, n, out.get() + k * n);
  }
  return owned(std::move(out), {kPointRows, n});
}

void require_rigid(const Pose& T) {
  bool rigid = std::isfinite(T(0, 3)) && std::isfinite(T(1, 3)) && std::isfinite(T(2, 3)) &&
               T(3, 0) == 0 && T(3, 1) == 0 && T(3, 2) == 0 && T(3, 3) == 1;
  // Rows must be orthonormal, and the third must be the cross product of the first two.
  for (int a = 0; a < 3; ++a) {
    const int b = (a + 1) % 3, c = (a + 2) % 3;
    const double square = T(a, 0) * T(a, 0) + T(a, 1) * T(a, 1) + T(a, 2) * T(a, 2);
    const double inner = T(0, a) * T(0, b) + T(1, a) * T(1, b) + T(2, a) * T(2, b);
    const double third = T(0, b) * T(1, c) - T(0, c) * T(1, b);
    rigid = rigid && std::fabs(square - 1) < 1e-6 && std::fabs(inner) < 1e-6 &&
            std::fabs(third - T(2, a)) < 1e-6;
  }
  require(rigid, "T_camera_reference must be a rigid transform");
}

nb::tuple normal_equations(Input<2> points, Input<3> texels, const Intrinsics& intrinsics,
                           Pose T_camera_reference, double gain, double bias,
                           double intensity_sigma, double depth_noise_scale,
                           std::tuple<double, double, double> noise, double gate, double occlusion,
                           const std::optional<Cells>& cells) {
  require(points.shape(0) == kPointRows, "points must be [7, N], as points() returns them");
  require_texels(texels);
  require_rigid(T_camera_reference);
  const auto [noise_floor, noise_growth, noise_nearest] = noise;
  require(noise_growth >= 0, "noise growth must be at least 0");
  Problem problem{};
  problem.points = points.data();
  problem.count = static_cast<std::int64_t>(points.shape(1));
  problem.target = texels.data();
  problem.height = static_cast<int>(texels.shape(0));
  problem.width = static_cast<int>(texels.shape(1));
  problem.camera = pinhole(intrinsics);
  for (int k = 0; k < 12; ++k)
    problem.T_camera_reference[k] = static_cast<float>(T_camera_reference(k / 4, k % 4));
  problem.gain = finite(gain, "gain");
  problem.bias = finite(bias, "bias");
  problem.intensity_sigma = positive(intensity_sigma, "intensity_sigma");
  problem.depth_noise_scale = positive(depth_noise_scale, "depth_noise_scale");
  problem.noise = {positive(noise_floor, "noise floor"), finite(noise_growth, "noise growth"),
                   finite(noise_nearest, "noise nearest")};
  problem.gate = positive(gate, "gate");
  problem.occlusion = positive(occlusion, "occlusion");
  const std::size_t cell_count = cells ? kCells : 0;
  std::unique_ptr<double[]> sums(new double[cell_count * 2 * kUnknowns]());
  if (cells) {
    require(cells->shape(0) == points.shape(1), "cells must have a number for each point");
    const std::uint8_t* numbers = cells->data();
    require(std::all_of(numbers, numbers + problem.count, [](auto n) { return n < kCells; }),
            "cells must be below 64");
  }
  Equations e;
  {
    nb::gil_scoped_release release;
    e = chosen->normal_equations(problem, cells ? cells->data() : nullptr, sums.get());
  }
  std::unique_ptr<double[]> hessian(new double[64]), gradient(new double[8]);
  std::copy_n(e.hessian, 64, hessian.get());
  std::copy_n(e.gradient, 8, gradient.get());
  return nb::make_tuple(
      owned(std::move(hessian), {8, 8}), owned(std::move(gradient), {8}),
      nb::make_tuple(e.visible, e.photometric_count, e.photometric_inliers, e.photometric_square,
                     e.geometric_count, e.geometric_inliers, e.geometric_square),
      owned(std::move(sums), {cell_count, 2, kUnknowns}));
}

}  // namespace

NB_MODULE(_align, m) {
  using namespace nb::literals;
  const ldo::Isa isa = ldo::chosen_isa();
  chosen = &kernels(isa);
  m.attr("isa") = ldo::name(isa);
  m.def("halve", &halve, "values"_a.noconvert(), "tolerance"_a, "least"_a = 1);
  m.def("halve_gray", &halve_gray, "gray"_a.noconvert(), "clipped"_a, "least"_a);
  m.def("pack", &pack, "image"_a.noconvert(), "depth_m"_a.noconvert(), "max_depth_m"_a);
  m.def("normals", &normals, "depth_m"_a.noconvert(), "intrinsics"_a, "radius"_a);
  m.def("points", &points, "texels"_a.noconvert(), "normals"_a.noconvert(), "intrinsics"_a);
  m.def("normal_equations", &normal_equations, "points"_a.noconvert(), "texels"_a.noconvert(),
        "intrinsics"_a, "T_camera_reference"_a.noconvert(), "gain"_a, "bias"_a, "intensity_sigma"_a,
        "depth_noise_scale"_a, "noise"_a, "gate"_a, "occlusion"_a, "cells"_a = nb::none());
}
