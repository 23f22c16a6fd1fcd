// Python binding of the rasteriser: checks what comes in, picks the instruction set.
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <cmath>
#include <memory>
#include <mutex>
#include <string>
#include <tuple>

#include "arrays.hpp"
#include "isa.hpp"
#include "rasterise.hpp"

namespace ldo {
namespace {

constexpr int kMaxSide = 32768;             // pixels
constexpr int64_t kMaxGaussians = 1 << 27;  // splats are counted with 32 bits

Isa isa = Isa::baseline;  // chosen when the module is imported

using Image = nb::ndarray<nb::numpy, float>;

// The functions of the chosen instruction set.
struct Kernels {
  decltype(&baseline::rasterise) rasterise;
  decltype(&baseline::new_pass) new_pass;
  decltype(&baseline::rasterise_planes) rasterise_planes;
  decltype(&baseline::backpropagate) backpropagate;
};

#define LDO_KERNELS(isa) \
  Kernels { isa::rasterise, isa::new_pass, isa::rasterise_planes, isa::backpropagate }
Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return LDO_KERNELS(avx512);
  if (isa == Isa::avx2) return LDO_KERNELS(avx2);
#endif
  (void)isa;
  return LDO_KERNELS(baseline);
}
#undef LDO_KERNELS

Kernels kernels;  // chosen with isa

// A pass as Python holds it: used by one call at a time.
class PassOfPython {
 public:
  PassOfPython() : pass_(kernels.new_pass()) {}
  bool is_rendered = false;

  class Use {
   public:
    explicit Use(PassOfPython& owner) : lock_(owner.busy_, std::try_to_lock), pass_(*owner.pass_) {
      require(lock_.owns_lock(), "this pass is in use by another thread: give each its own.");
    }
    Pass& operator*() const { return pass_; }
    Pass* operator->() const { return &pass_; }

   private:
    std::unique_lock<std::mutex> lock_;
    Pass& pass_;
  };

 private:
  std::unique_ptr<Pass> pass_;
  std::mutex busy_;
};

const float* rows_of(const Array& rows, const std::string& name) {
  require(rows.ndim() == 2 && rows.shape(1) == kRowFloats, name + " must have shape [N, 16].");
  require(rows.shape(0) <= static_cast<size_t>(kMaxGaussians), name + ": more than 2^27.");
  return values_of<float>(rows, name);
}

View view_of(const Array& T_camera_map, float fx, float fy, float cx, float cy, int width,
             int height) {
  require(T_camera_map.ndim() == 2 && T_camera_map.shape(0) == 3 && T_camera_map.shape(1) == 4,
          "T_camera_map must have shape [3, 4]: the upper rows of the transform.");
  require(width >= 1 && width <= kMaxSide && height >= 1 && height <= kMaxSide,
          "width and height must be 1 to " + std::to_string(kMaxSide) + " pixels, got " +
              std::to_string(width) + " x " + std::to_string(height) + ".");
  View view{{}, fx, fy, cx, cy, width, height};
  const float* T = values_of<float>(T_camera_map, "T_camera_map");
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
                                                 int height, int threads, PassOfPython* memory) {
  require_threads(threads);
  const float* data = rows_of(rows, "rows");
  const View view = view_of(T_camera_map, fx, fy, cx, cy, width, height);
  const size_t h = height, w = width, pixels = h * w;
  std::unique_ptr<float[]> color(new float[3 * pixels]), depth(new float[pixels]),
      median_depth(new float[pixels]), opacity(new float[pixels]);
  std::unique_ptr<PassOfPython> own(memory == nullptr ? new PassOfPython : nullptr);
  PassOfPython& held = memory == nullptr ? *own : *memory;
  const PassOfPython::Use pass(held);
  held.is_rendered = false;
  {
    nb::gil_scoped_release release;
    kernels.rasterise(data, rows.shape(0), view, threads, *pass,
                      {color.get(), depth.get(), median_depth.get(), opacity.get()});
  }
  return {image(color.release(), {h, w, 3}), image(depth.release(), {h, w}),
          image(median_depth.release(), {h, w}), image(opacity.release(), {h, w})};
}

int64_t rasterise_planes(PassOfPython& held, const Array& rows, const Array& T_camera_map, float fx,
                         float fy, float cx, float cy, const WritableArray& planes, int threads) {
  require_threads(threads);
  require(planes.ndim() == 3 && planes.shape(0) == kPlanes, "planes must have shape [5, H, W].");
  require(planes.shape(1) <= kMaxSide && planes.shape(2) <= kMaxSide, "planes are too large.");
  const float* data = rows_of(rows, "rows");
  float* images = values_of<float>(planes, "planes");
  const View view = view_of(T_camera_map, fx, fy, cx, cy, static_cast<int>(planes.shape(2)),
                            static_cast<int>(planes.shape(1)));
  const PassOfPython::Use pass(held);
  held.is_rendered = false;
  {
    nb::gil_scoped_release release;
    kernels.rasterise_planes(data, rows.shape(0), view, threads, *pass, images);
  }
  held.is_rendered = true;
  return pass->visible;
}

nb::ndarray<nb::numpy, double> backpropagate(PassOfPython& held, const Array& rows,
                                             const Array& planes, const Array& gradients,
                                             const WritableArray& indices,
                                             const WritableArray& row_gradients,
                                             float needle_weight, float needle_log_ratio,
                                             int threads) {
  require_threads(threads);
  const PassOfPython::Use pass(held);
  require(needle_weight >= 0 && needle_log_ratio >= 0, "the needle penalty must not be negative.");
  require(held.is_rendered, "this pass holds no rendering: call rasterise_planes first.");
  const size_t height = pass->view.height, width = pass->view.width, visible = pass->visible;
  const float* data = rows_of(rows, "rows");
  require(static_cast<int64_t>(rows.shape(0)) == pass->gaussians,
          "rows are not those that were rendered: their number has changed.");
  require_shape(planes, "planes", {kPlanes, height, width});
  require_shape(gradients, "gradients", {kPlanes, height, width});
  require_shape(indices, "indices", {visible});
  require_shape(row_gradients, "row_gradients", {visible, kRowFloats});
  const float *images = values_of<float>(planes, "planes"),
              *by_images = values_of<float>(gradients, "gradients");
  std::unique_ptr<double[]> pose(new double[6]);
  const Gradients out{values_of<uint32_t>(indices, "indices"),
                      values_of<float>(row_gradients, "row_gradients"), pose.get()};
  {
    nb::gil_scoped_release release;
    kernels.backpropagate(data, *pass, images, by_images, {needle_weight, needle_log_ratio},
                          threads, out);
  }
  nb::capsule owner(pose.get(), [](void* p) noexcept { delete[] static_cast<double*>(p); });
  return nb::ndarray<nb::numpy, double>(pose.release(), {6}, owner);
}

}  // namespace

NB_MODULE(_rasterise, m) {
  using namespace nb::literals;
  isa = chosen_isa();
  kernels = kernels_for(isa);
  nb::class_<PassOfPython>(m, "Pass").def(nb::init<>());
  m.def("isa", [] { return std::string(name(isa)); });
  m.def("rasterise", &rasterise, "rows"_a, "T_camera_map"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a,
        "width"_a, "height"_a, "threads"_a = 1, "memory"_a = nb::none());
  m.def("rasterise_planes", &rasterise_planes, "forward"_a, "rows"_a, "T_camera_map"_a, "fx"_a,
        "fy"_a, "cx"_a, "cy"_a, "planes"_a, "threads"_a = 1);
  m.def("backpropagate", &backpropagate, "forward"_a, "rows"_a, "planes"_a, "gradients"_a,
        "indices"_a, "row_gradients"_a, "needle_weight"_a = 0.0f, "needle_log_ratio"_a = 0.0f,
        "threads"_a = 1);
}

}  // namespace ldo
