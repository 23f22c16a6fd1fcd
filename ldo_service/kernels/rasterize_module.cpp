// Python binding of the rasterizer. It checks the arguments and selects the instruction set.
#include <nanobind/stl/optional.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <limits>
#include <memory>
#include <mutex>
#include <string>
#include <tuple>
#include <vector>

#include "adam_arguments.hpp"
#include "isa.hpp"
#include "rasterize.hpp"

namespace ldo {
namespace {

constexpr int kMaxSide = 32768;             // Pixels.
constexpr int64_t kMaxGaussians = 1 << 27;  // Splats are counted with 32 bits.

Isa isa = Isa::baseline;  // Set when the module is imported.

using Image = nb::ndarray<nb::numpy, float>;

// Functions of the chosen instruction set.
struct Kernels {
  decltype(&baseline::rasterize) rasterize;
  decltype(&baseline::contributions) contributions;
  decltype(&baseline::new_pass) new_pass;
  decltype(&baseline::rasterize_planes) rasterize_planes;
  decltype(&baseline::backpropagate) backpropagate;
  decltype(&baseline::descend) descend;
};

#define LDO_KERNELS(isa)                                                                          \
  Kernels {                                                                                       \
    isa::rasterize, isa::contributions, isa::new_pass, isa::rasterize_planes, isa::backpropagate, \
        isa::descend                                                                              \
  }
Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return LDO_KERNELS(avx512);
  if (isa == Isa::avx2) return LDO_KERNELS(avx2);
#endif
  (void)isa;
  return LDO_KERNELS(baseline);
}
#undef LDO_KERNELS

Kernels kernels;  // Set together with `isa`.

// Lock on an object that only one call at a time may use.
class Exclusive {
 public:
  explicit Exclusive(std::mutex& busy) : lock_(busy, std::try_to_lock) {
    require(lock_.owns_lock(),
            "this pass or these bounds are in use by another thread: give each thread its own.");
  }

 private:
  std::unique_lock<std::mutex> lock_;
};

// Python object `Pass`: a pass with a lock.
class PassOfPython {
 public:
  PassOfPython() : pass_(kernels.new_pass()) {}
  bool is_rendered = false;

  class Use : Exclusive {
   public:
    explicit Use(PassOfPython& owner) : Exclusive(owner.busy_), pass_(*owner.pass_) {}
    Pass& operator*() const { return pass_; }
    Pass* operator->() const { return &pass_; }

   private:
    Pass& pass_;
  };

 private:
  std::unique_ptr<Pass> pass_;
  std::mutex busy_;
};

// Bounds of the blocks of an array of rows. The owner of the rows must report every change.
class BoundsOfPython {
 public:
  // Mark rows [first, last) as changed.
  void forget(int64_t first, int64_t last) {
    const Exclusive use(busy_);
    require(0 <= first && first <= last, "rows [first, last) must not be negative.");
    const int64_t size = blocks_.size();
    for (int64_t block = first / kBlockRows; block < size && block * kBlockRows < last; ++block)
      blocks_[block].is_known = false;
  }
  void forget_rows(const Array& indices) {
    const Exclusive use(busy_);
    require(indices.ndim() == 1, "indices must have shape [M].");
    const uint32_t* rows = values_of<uint32_t>(indices, "indices");
    for (size_t i = 0; i < indices.shape(0); ++i)
      if (rows[i] / kBlockRows < blocks_.size()) blocks_[rows[i] / kBlockRows].is_known = false;
  }

  class Use : Exclusive {
   public:
    explicit Use(BoundsOfPython& owner) : Exclusive(owner.busy_), owner_(owner) {}
    BlockBound* of(const float* rows, int64_t n) const { return owner_.follow(rows, n); }

   private:
    BoundsOfPython& owner_;
  };

 private:
  // Return the bounds of `rows`. Rows that moved in memory, or were appended, have unknown bounds.
  BlockBound* follow(const float* rows, int64_t n) {
    if (rows != rows_) blocks_.clear();
    if (n > n_ && n_ / kBlockRows < static_cast<int64_t>(blocks_.size()))
      blocks_[n_ / kBlockRows].is_known = false;
    blocks_.resize((n + kBlockRows - 1) / kBlockRows);
    rows_ = rows;
    n_ = n;
    return blocks_.data();
  }

  std::vector<BlockBound> blocks_;
  const float* rows_ = nullptr;
  int64_t n_ = 0;
  std::mutex busy_;
};

template <class AnyArray>
const float* rows_of(const AnyArray& rows, const std::string& name) {
  require(rows.ndim() == 2 && rows.shape(1) == kRowFloats, name + " must have shape [N, 16].");
  require(rows.shape(0) <= static_cast<size_t>(kMaxGaussians),
          name + " must hold at most 2^27 Gaussians.");
  return values_of<float>(rows, name);
}

View view_of(const Array& T_camera_map, float fx, float fy, float cx, float cy, int width,
             int height, int binning = 1) {
  require(T_camera_map.ndim() == 2 && T_camera_map.shape(0) == 3 && T_camera_map.shape(1) == 4,
          "T_camera_map must have shape [3, 4]: the upper rows of the transform.");
  require(width >= 1 && width <= kMaxSide && height >= 1 && height <= kMaxSide,
          "width and height must be 1 to " + std::to_string(kMaxSide) + " pixels, got " +
              std::to_string(width) + " x " + std::to_string(height) + ".");
  require(binning == 1 || binning == 2, "binning must be 1 or 2.");
  View view{{}, fx, fy, cx, cy, width, height};
  if (binning == 2) {                   // Each pixel is the mean of 2 x 2 full pixels.
    view.box = (1.0f - 0.25f) / 12.0f;  // A box of width b has the variance b^2 / 12.
    view.low_pass = 0.25f * view.low_pass + view.box;
  }
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

// Gaussians of one rendering. Bounds that the caller gave are locked while this object exists.
class Seen {
 public:
  Seen(const Array& rows, BoundsOfPython* bounds)
      : gaussians{rows_of(rows, "rows"), static_cast<int64_t>(rows.shape(0)), nullptr} {
    if (bounds == nullptr) return;
    use_.emplace(*bounds);
    gaussians.bounds = use_->of(gaussians.rows, gaussians.n);
  }
  Gaussians gaussians;

 private:
  std::optional<BoundsOfPython::Use> use_;
};

std::tuple<Image, Image, Image, Image> rasterize(const Array& rows, const Array& T_camera_map,
                                                 float fx, float fy, float cx, float cy, int width,
                                                 int height, int threads, PassOfPython* memory,
                                                 BoundsOfPython* bounds) {
  require_threads(threads);
  const Seen seen(rows, bounds);
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
    kernels.rasterize(seen.gaussians, view, threads, *pass,
                      {color.get(), depth.get(), median_depth.get(), opacity.get()});
  }
  held.is_rendered = true;
  return {image(color.release(), {h, w, 3}), image(depth.release(), {h, w}),
          image(median_depth.release(), {h, w}), image(opacity.release(), {h, w})};
}

int64_t rasterize_planes(PassOfPython& held, const Array& rows, const Array& T_camera_map, float fx,
                         float fy, float cx, float cy, const WritableArray& planes, int threads,
                         BoundsOfPython* bounds, const std::optional<Array>& tiles, int binning) {
  require_threads(threads);
  require(planes.ndim() == 3 && planes.shape(0) == kPlanes, "planes must have shape [5, H, W].");
  require(planes.shape(1) <= kMaxSide && planes.shape(2) <= kMaxSide,
          "planes may have at most 32768 pixels a side.");
  const Seen seen(rows, bounds);
  float* images = values_of<float>(planes, "planes");
  const View view = view_of(T_camera_map, fx, fy, cx, cy, static_cast<int>(planes.shape(2)),
                            static_cast<int>(planes.shape(1)), binning);
  const auto across = [](size_t pixels) { return (pixels + kTile - 1) / kTile; };
  if (tiles) require_shape(*tiles, "tiles", {across(planes.shape(1)), across(planes.shape(2))});
  const uint8_t* wanted = tiles ? values_of<uint8_t>(*tiles, "tiles") : nullptr;
  const PassOfPython::Use pass(held);
  held.is_rendered = false;
  {
    nb::gil_scoped_release release;
    kernels.rasterize_planes(seen.gaussians, view, wanted, threads, *pass, images);
  }
  held.is_rendered = true;
  return pass->visible;
}

void contributions(PassOfPython& held, const WritableArray& indices, const WritableArray& weights,
                   const WritableArray& top, int threads) {
  require_threads(threads);
  const PassOfPython::Use pass(held);
  require(held.is_rendered, "this pass holds no rendering: call rasterize first.");
  const size_t visible = pass->visible;
  require_shape(indices, "indices", {visible});
  require_shape(weights, "weights", {visible});
  require_shape(top, "top",
                {static_cast<size_t>(pass->view.height), static_cast<size_t>(pass->view.width)});
  const Contributions out{values_of<uint32_t>(indices, "indices"),
                          values_of<float>(weights, "weights"), values_of<int32_t>(top, "top")};
  nb::gil_scoped_release release;
  kernels.contributions(*pass, threads, out);
}

int64_t visible(PassOfPython& held) { return PassOfPython::Use(held)->visible; }

using PoseGradient = nb::ndarray<nb::numpy, double>;

PoseGradient pose_gradient(std::unique_ptr<double[]> values) {
  nb::capsule owner(values.get(), [](void* p) noexcept { delete[] static_cast<double*>(p); });
  return PoseGradient(values.release(), {6}, owner);
}

// Checked arguments that all derivatives of a rendering share.
struct Backward {
  template <class AnyArray>
  Backward(PassOfPython& held, const AnyArray& rows, const Array& planes, const Array& gradients,
           float needle_weight, float needle_log_ratio, int threads)
      : pass(held), penalty{needle_weight, needle_log_ratio}, threads(threads) {
    require_threads(threads);
    require(needle_weight >= 0 && needle_log_ratio >= 0,
            "the needle penalty must not be negative.");
    require(held.is_rendered, "this pass holds no rendering: call rasterize_planes first.");
    const size_t height = pass->view.height, width = pass->view.width;
    require(rows_of(rows, "rows") == pass->rows &&
                static_cast<int64_t>(rows.shape(0)) == pass->gaussians,
            "rows are not those that were rendered: give the rows of the last rendering.");
    require_shape(planes, "planes", {kPlanes, height, width});
    require_shape(gradients, "gradients", {kPlanes, height, width});
    images = values_of<float>(planes, "planes");
    by_images = values_of<float>(gradients, "gradients");
  }
  PassOfPython::Use pass;
  const NeedlePenalty penalty;
  const int threads;
  const float *images, *by_images;
};

PoseGradient backpropagate(PassOfPython& held, const Array& rows, const Array& planes,
                           const Array& gradients, const WritableArray& indices,
                           const WritableArray& row_gradients, float needle_weight,
                           float needle_log_ratio, int threads) {
  const Backward b(held, rows, planes, gradients, needle_weight, needle_log_ratio, threads);
  const size_t visible = b.pass->visible;
  require_shape(indices, "indices", {visible});
  require_shape(row_gradients, "row_gradients", {visible, kRowFloats});
  std::unique_ptr<double[]> pose(new double[6]);
  const Gradients out{values_of<uint32_t>(indices, "indices"),
                      values_of<float>(row_gradients, "row_gradients"), pose.get()};
  {
    nb::gil_scoped_release release;
    kernels.backpropagate(*b.pass, b.images, b.by_images, b.penalty, threads, out);
  }
  return pose_gradient(std::move(pose));
}

PoseGradient descend(PassOfPython& held, const WritableArray& rows, const WritableArray& mean,
                     const WritableArray& square, const WritableArray& steps, const Array& rates,
                     float beta1, float beta2, float epsilon, const Array& planes,
                     const Array& gradients, const WritableArray& indices,
                     const WritableArray& weights, float needle_weight, float needle_log_ratio,
                     float max_sigma_px, int threads) {
  const Backward b(held, rows, planes, gradients, needle_weight, needle_log_ratio, threads);
  require(max_sigma_px > 0, "max_sigma_px must be positive.");
  const AdamRows state = adam_rows_of(rows, mean, square, steps);
  const AdamRates hyper = adam_rates_of(rates, beta1, beta2, epsilon);
  const size_t visible = b.pass->visible;
  require_shape(indices, "indices", {visible});
  require_shape(weights, "weights", {visible});
  std::unique_ptr<double[]> pose(new double[6]);
  const Reached out{values_of<uint32_t>(indices, "indices"), values_of<float>(weights, "weights"),
                    pose.get()};
  held.is_rendered = false;  // The rows are about to change.
  {
    nb::gil_scoped_release release;
    kernels.descend(*b.pass, b.images, b.by_images, b.penalty, {max_sigma_px}, state, hyper,
                    threads, out);
  }
  return pose_gradient(std::move(pose));
}

}  // namespace

NB_MODULE(_rasterize, m) {
  using namespace nb::literals;
  isa = chosen_isa();
  kernels = kernels_for(isa);
  nb::class_<PassOfPython>(m, "Pass").def(nb::init<>()).def_prop_ro("visible", &visible);
  nb::class_<BoundsOfPython>(m, "Bounds")
      .def(nb::init<>())
      .def("forget", &BoundsOfPython::forget, "first"_a = 0, "last"_a = kMaxGaussians)
      .def("forget_rows", &BoundsOfPython::forget_rows, "indices"_a);
  m.def("isa", [] { return std::string(name(isa)); });
  m.def("rasterize", &rasterize, "rows"_a, "T_camera_map"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a,
        "width"_a, "height"_a, "threads"_a = 1, "memory"_a = nb::none(), "bounds"_a = nb::none());
  m.def("rasterize_planes", &rasterize_planes, "forward"_a, "rows"_a, "T_camera_map"_a, "fx"_a,
        "fy"_a, "cx"_a, "cy"_a, "planes"_a, "threads"_a = 1, "bounds"_a = nb::none(),
        "tiles"_a = nb::none(), "binning"_a = 1);
  m.def("backpropagate", &backpropagate, "forward"_a, "rows"_a, "planes"_a, "gradients"_a,
        "indices"_a, "row_gradients"_a, "needle_weight"_a = 0.0f, "needle_log_ratio"_a = 0.0f,
        "threads"_a = 1);
  m.def("contributions", &contributions, "forward"_a, "indices"_a, "weights"_a, "top"_a,
        "threads"_a = 1);
  m.def("descend", &descend, "forward"_a, "rows"_a, "mean"_a, "square"_a, "steps"_a, "rates"_a,
        "beta1"_a, "beta2"_a, "epsilon"_a, "planes"_a, "gradients"_a, "indices"_a, "weights"_a,
        "needle_weight"_a = 0.0f, "needle_log_ratio"_a = 0.0f,
        "max_sigma_px"_a = std::numeric_limits<float>::infinity(), "threads"_a = 1);
}

}  // namespace ldo
