// Python binding of the label kernels. It checks the arguments and selects the instruction set.
#include <cmath>
#include <vector>

#include "arrays.hpp"
#include "isa.hpp"
#include "labels.hpp"

namespace ldo {
namespace {

struct Kernels {
  decltype(&baseline::assign) assign;
  decltype(&baseline::update) update;
  decltype(&baseline::agree) agree;
};

Kernels kernels_for(Isa isa) {
#if LDO_X86
  if (isa == Isa::avx512) return {avx512::assign, avx512::update, avx512::agree};
  if (isa == Isa::avx2) return {avx2::assign, avx2::update, avx2::agree};
#endif
  (void)isa;
  return {baseline::assign, baseline::update, baseline::agree};
}

Kernels kernels;  // Set when the module is imported.

// Check the indices and return them. They must be distinct, because two threads might otherwise
// write the same row.
const uint32_t* indices_of(const Array& indices, size_t n) {
  require(indices.ndim() == 1, "indices must have shape [V].");
  const uint32_t* which = values_of<uint32_t>(indices, "indices");
  const size_t v = indices.shape(0);
  bool is_wrong = v > 0 && which[v - 1] >= n;
  // The loop checks all pairs, so that it vectorizes.
  for (size_t i = 1; i < v; ++i) is_wrong |= which[i - 1] >= which[i];
  require(!is_wrong, "indices must ascend and be below the number of rows.");
  return which;
}

bool is_share(float x) { return x >= 0.0f && x <= 1.0f; }

class CheckedRegions {
 public:
  CheckedRegions(const Array& boxes, const Array& scores, const Array& rects, const Array& sums) {
    require(boxes.ndim() == 2 && boxes.shape(1) == 4, "boxes must have shape [M, 4].");
    const size_t m = boxes.shape(0);
    require_shape(scores, "scores", {m});
    require_shape(rects, "rects", {m, 4});
    require(sums.ndim() == 1, "sums must have shape [S].");
    regions_ = {static_cast<int64_t>(m),
                values_of<float>(boxes, "boxes"),
                values_of<float>(scores, "scores"),
                values_of<int32_t>(rects, "rects"),
                nullptr,
                values_of<int32_t>(sums, "sums")};
    require_values();
    lay_out(static_cast<int64_t>(sums.shape(0)));
  }
  Regions regions() const {
    Regions out = regions_;
    out.offsets = offsets_.data();
    return out;
  }

 private:
  void require_values() const {
    for (int64_t j = 0; j < regions_.m; ++j) {
      const float* box = regions_.boxes + 4 * j;
      bool finite = true;
      for (int k = 0; k < 4; ++k) finite = finite && std::isfinite(box[k]);
      require(finite && box[0] <= box[2] && box[1] <= box[3],
              "boxes must be finite, x0 <= x1 and y0 <= y1.");
      require(is_share(regions_.scores[j]), "scores must lie in 0..1.");
    }
  }
  void lay_out(int64_t size) {
    int64_t end = 0;
    for (int64_t j = 0; j < regions_.m; ++j) {
      const int64_t width = regions_.rects[4 * j + 2], height = regions_.rects[4 * j + 3];
      require(width >= 0 && height >= 0 && (width == 0) == (height == 0),
              "rects must have a width and a height, or neither.");
      offsets_.push_back(end);
      if (width > 0) end += (width + 1) * (height + 1);
    }
    require(end == size, "sums must hold (width + 1) (height + 1) values per rectangle.");
  }

  Regions regions_{};
  std::vector<int64_t> offsets_;
};

View view_of(const Array& T_camera_map, float fx, float fy, float cx, float cy,
             const Array& depth_m) {
  require_shape(T_camera_map, "T_camera_map", {3, 4});
  require(depth_m.ndim() == 2 && depth_m.size() > 0, "depth_m must have shape [H, W].");
  const float* T = values_of<float>(T_camera_map, "T_camera_map");
  View view{
      {}, fx, fy, cx, cy, static_cast<int>(depth_m.shape(1)), static_cast<int>(depth_m.shape(0))};
  bool finite = std::isfinite(cx) && std::isfinite(cy) && std::isfinite(fx) && std::isfinite(fy);
  for (int i = 0; i < 12; ++i) finite = finite && std::isfinite(view.T_camera_map[i] = T[i]);
  require(finite && fx > 0 && fy > 0, "the camera must be finite, with positive focal lengths.");
  return view;
}

void assign(const Array& rows, const Array& indices, const Array& T_camera_map, float fx, float fy,
            float cx, float cy, const Array& depth_m, const Array& boxes, const Array& scores,
            const Array& rects, const Array& sums, bool by_iou, float min_overlap,
            float max_depth_gap_m, float max_front_gap_m, const WritableArray& region,
            const WritableArray& overlap, const WritableArray& z, int threads) {
  require_threads(threads);
  require(rows.ndim() == 2 && rows.shape(1) == kRowFloats, "rows must have shape [N, 16].");
  const float* gaussians = values_of<float>(rows, "rows");
  const uint32_t* which = indices_of(indices, rows.shape(0));
  const View view = view_of(T_camera_map, fx, fy, cx, cy, depth_m);
  const float* depth = values_of<float>(depth_m, "depth_m");
  const CheckedRegions checked(boxes, scores, rects, sums);
  require(is_share(min_overlap), "min_overlap must lie in 0..1.");
  require(max_depth_gap_m > 0, "max_depth_gap_m must be positive.");
  require(max_front_gap_m > 0, "max_front_gap_m must be positive.");
  const size_t v = indices.shape(0);
  require_shape(region, "region", {v});
  require_shape(overlap, "overlap", {v});
  require_shape(z, "z", {v});
  const Assignments out{values_of<int32_t>(region, "region"), values_of<float>(overlap, "overlap"),
                        values_of<float>(z, "z")};
  nb::gil_scoped_release release;
  kernels.assign(gaussians, which, static_cast<int64_t>(v), view, depth, checked.regions(),
                 {by_iou, min_overlap, max_depth_gap_m, max_front_gap_m}, out, threads);
}

LabelRow* label_rows_of(const WritableArray& rows) {
  require(rows.ndim() == 2 && rows.shape(1) == sizeof(LabelRow), "labels must have shape [N, 32].");
  uint8_t* bytes = values_of<uint8_t>(rows, "labels");
  require(reinterpret_cast<uintptr_t>(bytes) % alignof(LabelRow) == 0, "labels must be aligned.");
  return reinterpret_cast<LabelRow*>(bytes);
}

void require_observations(const Observations& seen, size_t v) {
  bool labels = true, confident = true, sized = true;
  for (size_t i = 0; i < v; ++i) {
    const int label = seen.label[i];
    const float c = seen.confidence[i];
    labels &= (label >= kNotSeen) & (label < 256);
    confident &= (label < 0) | ((c >= 0.0f) & (c <= 1.0f));
    sized &= seen.extent_m[i] >= 0.0f;
  }
  require(labels, "observed must hold labels below 256, -1 for a miss or -2 for no observation.");
  require(confident, "confidences must lie in 0..1.");
  require(sized, "extents must not be negative.");
}

void update(const WritableArray& labels, const Array& indices, const Array& observed,
            const Array& confidence, const Array& extent_m, bool is_corrected, float keep,
            float miss_weight, int miss_limit, float usual_extent_m, float hold_back, int threads) {
  require_threads(threads);
  LabelRow* rows = label_rows_of(labels);
  const uint32_t* which = indices_of(indices, labels.shape(0));
  const size_t v = indices.shape(0);
  require_shape(observed, "observed", {v});
  require_shape(confidence, "confidence", {v});
  require_shape(extent_m, "extent_m", {v});
  const Observations seen{values_of<int16_t>(observed, "observed"),
                          values_of<float>(confidence, "confidence"),
                          values_of<float>(extent_m, "extent_m")};
  require_observations(seen, v);
  require(keep >= 0 && keep < 1 && is_share(hold_back) && is_share(miss_weight),
          "keep must be in [0, 1), hold_back and miss_weight in 0..1.");
  require(usual_extent_m >= 0, "usual_extent_m must not be negative.");
  require(miss_limit >= 1 && miss_limit <= 255, "miss_limit must be in 1..255.");
  nb::gil_scoped_release release;
  kernels.update(rows, which, static_cast<int64_t>(v), seen,
                 {is_corrected, keep, miss_weight, miss_limit, usual_extent_m, hold_back}, threads);
}

nb::tuple agree(const Array& rows, const WritableArray& labels, const Array& indices, float sigma_m,
                float radius_m, float rate, int threads) {
  require_threads(threads);
  require_shape(rows, "rows", {labels.ndim() == 2 ? labels.shape(0) : 0, kRowFloats});
  const float* gaussians = values_of<float>(rows, "rows");
  LabelRow* label_rows = label_rows_of(labels);
  const uint32_t* which = indices_of(indices, labels.shape(0));
  const int64_t v = static_cast<int64_t>(indices.shape(0));
  require(sigma_m > 0 && std::isfinite(sigma_m) && radius_m > 0,
          "sigma_m and radius_m must be positive, and sigma_m finite.");
  require(is_share(rate), "rate must lie in 0..1.");
  Disagreement out;
  {
    nb::gil_scoped_release release;
    out = kernels.agree(gaussians, label_rows, which, v, {sigma_m, radius_m, rate}, threads);
  }
  return nb::make_tuple(out.literal, out.expected);
}

}  // namespace

NB_MODULE(_labels, m) {
  using namespace nb::literals;
  kernels = kernels_for(chosen_isa());
  m.def("assign", &assign, "rows"_a, "indices"_a, "T_camera_map"_a, "fx"_a, "fy"_a, "cx"_a, "cy"_a,
        "depth_m"_a, "boxes"_a, "scores"_a, "rects"_a, "sums"_a, "by_iou"_a, "min_overlap"_a,
        "max_depth_gap_m"_a, "max_front_gap_m"_a, "region"_a, "overlap"_a, "z"_a, "threads"_a = 1);
  m.def("update", &update, "labels"_a, "indices"_a, "observed"_a, "confidence"_a, "extent_m"_a,
        "is_corrected"_a, "keep"_a, "miss_weight"_a, "miss_limit"_a, "usual_extent_m"_a,
        "hold_back"_a, "threads"_a = 1);
  m.def("agree", &agree, "rows"_a, "labels"_a, "indices"_a, "sigma_m"_a, "radius_m"_a, "rate"_a,
        "threads"_a = 1);
}

}  // namespace ldo
