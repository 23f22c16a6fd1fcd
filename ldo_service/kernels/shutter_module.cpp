// Python binding of the compensation of the camera's motion during a frame. It checks the arguments
// and selects the instruction set.
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <memory>
#include <tuple>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "isa.hpp"
#include "shutter.hpp"

namespace ldo {
namespace {

struct Kernels {
  decltype(&baseline::image_motion) image_motion;
  decltype(&baseline::warp) warp;
};

Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return {avx512::image_motion, avx512::warp};
  if (isa == Isa::avx2) return {avx2::image_motion, avx2::warp};
#endif
  (void)isa;
  return {baseline::image_motion, baseline::warp};
}

Kernels chosen{};  // Set when the module is imported.

using Intrinsics = std::tuple<double, double, double, double>;
using Times = std::tuple<double, double, double>;

MovingCamera moving_camera(const Array& depth, const Intrinsics& intrinsics,
                           const Array& velocity) {
  require(depth.ndim() == 2, "depth must have shape [H, W].");
  const size_t height = depth.shape(0), width = depth.shape(1);
  require(std::min(height, width) >= 1 && std::max(height, width) <= 32768,
          "depth must have 1 to 32768 pixels a side.");
  require_shape(velocity, "velocity", {6});
  const auto [fx, fy, cx, cy] = intrinsics;
  require(std::isfinite(cx) && std::isfinite(cy) && std::isfinite(fx) && std::isfinite(fy) &&
              fx > 0 && fy > 0,
          "intrinsics (fx, fy, cx, cy) must be finite, focal lengths positive.");
  MovingCamera camera{};
  camera.width = static_cast<int>(width), camera.height = static_cast<int>(height);
  camera.fx = static_cast<float>(fx), camera.fy = static_cast<float>(fy);
  camera.cx = static_cast<float>(cx), camera.cy = static_cast<float>(cy);
  const double* values = values_of<double>(velocity, "velocity");
  std::transform(values, values + 6, camera.velocity,
                 [](double value) { return static_cast<float>(value); });
  return camera;
}

template <class T>
nb::ndarray<nb::numpy, T> owned(std::unique_ptr<T[]> data, const std::vector<size_t>& shape) {
  T* raw = data.release();
  nb::capsule owner(raw, [](void* p) noexcept { delete[] static_cast<T*>(p); });
  return nb::ndarray<nb::numpy, T>(raw, shape.size(), shape.data(), owner);
}

nb::ndarray<nb::numpy, float> image_motion(const Array& depth, const Intrinsics& intrinsics,
                                           const Array& velocity) {
  const MovingCamera camera = moving_camera(depth, intrinsics, velocity);
  const float* meters = values_of<float>(depth, "depth");
  const size_t rows = camera.rows(), columns = camera.columns();
  std::unique_ptr<float[]> motion(new float[kMotionPlanes * rows * columns]);
  {
    nb::gil_scoped_release release;
    chosen.image_motion(meters, camera, motion.get());
  }
  return owned(std::move(motion), {kMotionPlanes, rows, columns});
}

std::tuple<nb::ndarray<nb::numpy, uint8_t>, nb::ndarray<nb::numpy, float>> warp(
    const Array& image, const Array& depth, const Intrinsics& intrinsics, const Array& velocity,
    const Times& times_s) {
  const MovingCamera camera = moving_camera(depth, intrinsics, velocity);
  const size_t height = camera.height, width = camera.width;
  const bool is_gray = image.ndim() == 2;
  if (is_gray)
    require_shape(image, "image", {height, width});
  else
    require_shape(image, "image", {height, width, 3});
  const auto [readout_s, depth_readout_s, depth_delay_s] = times_s;
  const RowTimes times{static_cast<float>(readout_s), static_cast<float>(depth_readout_s),
                       static_cast<float>(depth_delay_s)};
  const Frame frame{values_of<uint8_t>(image, "image"), values_of<float>(depth, "depth")};
  const int channels = is_gray ? 1 : 3;
  std::unique_ptr<uint8_t[]> color(new uint8_t[height * width * channels]);
  std::unique_ptr<float[]> meters(new float[height * width]);
  {
    nb::gil_scoped_release release;
    chosen.warp(frame, channels, camera, times, {color.get(), meters.get()});
  }
  std::vector<size_t> shape{height, width};
  if (!is_gray) shape.push_back(3);
  return {owned(std::move(color), shape), owned(std::move(meters), {height, width})};
}

}  // namespace

NB_MODULE(_shutter, m) {
  using namespace nb::literals;
  chosen = kernels_for(chosen_isa());
  m.def("image_motion", &image_motion, "depth"_a, "intrinsics"_a, "velocity"_a);
  m.def("warp", &warp, "image"_a, "depth"_a, "intrinsics"_a, "velocity"_a, "times_s"_a);
}

}  // namespace ldo
