// Python binding of the rasteriser: checks what comes in, picks the instruction set.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <cmath>
#include <memory>
#include <string>
#include <tuple>

#include "isa.hpp"
#include "rasterise.hpp"

namespace nb = nanobind;

namespace ldo {
namespace {

constexpr int kMaxSide = 32768;             // pixels
constexpr int64_t kMaxGaussians = 1 << 27;  // splats are counted with 32 bits

Isa isa = Isa::baseline;  // chosen when the module is imported

auto rasterise_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return avx512::rasterise;
  if (isa == Isa::avx2) return avx2::rasterise;
#endif
  (void)isa;
  return baseline::rasterise;
}

using Array = nb::ndarray<nb::ro>;
using Image = nb::ndarray<nb::numpy, float>;

void require(bool condition, const std::string& message) {
  if (!condition) throw nb::value_error(message.c_str());
}

const float* floats_of(const Array& array, const std::string& name) {
  require(array.dtype() == nb::dtype<float>() && array.device_type() == nb::device::cpu::value,
          name + " must be float32 in main memory.");
  int64_t stride = 1;
  for (size_t axis = array.ndim(); axis-- > 0; stride *= array.shape(axis))
    require(array.shape(axis) < 2 || array.stride(axis) == stride,
            name + " must be contiguous, last axis fastest: use np.ascontiguousarray.");
  return static_cast<const float*>(array.data());
}

View view_of(const Array& T_camera_map, float fx, float fy, float cx, float cy, int width,
             int height) {
  require(T_camera_map.ndim() == 2 && T_camera_map.shape(0) == 3 && T_camera_map.shape(1) == 4,
          "T_camera_map must have shape [3, 4]: the upper rows of the transform.");
  require(width >= 1 && width <= kMaxSide && height >= 1 && height <= kMaxSide,
          "width and height must be 1 to " + std::to_string(kMaxSide) + " pixels, got " +
              std::to_string(width) + " x " + std::to_string(height) + ".");
  View view{{}, fx, fy, cx, cy, width, height};
  const float* T = floats_of(T_camera_map, "T_camera_map");
  bool finite = std::isfinite(fx) && std::isfinite(fy) && std::isfinite(cx) && std::isfinite(cy);
  for (int i = 0; i < 12; ++i) finite = finite && std::isfinite(view.T_camera_map[i] = T[i]);
  require(finite, "the camera holds NaN or infinity.");
  require(fx > 0 && fy > 0, "focal lengths must be positive.");
  return view;
}

Image image(float* data, std::initializer_list<size_t> shape) {
  nb::capsule owner(data, [](void* p) noexcept { delete[] static_cast<float*>(p); });
  return Image(data, shape, owner);
}

std::tuple<Image, Image, Image, Image> rasterise(const Array& rows, const Array& T_camera_map,
                                                 float fx, float fy, float cx, float cy, int width,
                                                 int height, int threads) {
  require(rows.ndim() == 2 && rows.shape(1) == kRowFloats, "rows must have shape [N, 16].");
  require(rows.shape(0) <= static_cast<size_t>(kMaxGaussians), "rows: more than 2^27 Gaussians.");
  require(threads >= 1, "threads must be at least 1, got " + std::to_string(threads) + ".");
  const float* data = floats_of(rows, "rows");
  const View view = view_of(T_camera_map, fx, fy, cx, cy, width, height);
  const size_t h = height, w = width, pixels = h * w;
  std::unique_ptr<float[]> color(new float[3 * pixels]), depth(new float[pixels]),
      median_depth(new float[pixels]), opacity(new float[pixels]);
  {
    nb::gil_scoped_release release;
    rasterise_for(isa)(data, rows.shape(0), view, threads,
                       {color.get(), depth.get(), median_depth.get(), opacity.get()});
  }
  return {image(color.release(), {h, w, 3}), image(depth.release(), {h, w}),
          image(median_depth.release(), {h, w}), image(opacity.release(), {h, w})};
}

}  // namespace

NB_MODULE(_rasterise, m) {
  using namespace nb::literals;
  isa = chosen_isa();
  m.def("isa", [] { return std::string(name(isa)); });
  m.def("rasterise", &rasterise, "rows"_a, "T_camera_map"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a,
        "width"_a, "height"_a, "threads"_a = 1);
}

}  // namespace ldo
