// Smooth surfaces of a depth image, and what of a box is the object. Interface; no instruction set
// here. Images are dense and row-major, pixel centres at integers; depth that is not above 0 is
// missing.
#pragma once
#include <cstdint>
#include <vector>

namespace ldo {

struct DepthImage {
  const float* depth_m;  // [height, width]
  int width, height;
};

struct Pinhole {
  double fx, fy, cx, cy;  // pixels
};

struct SurfaceRule {
  float max_ratio;   // of depths within 3x3 pixels of one surface, below it
  float min_cosine;  // of normals 4 px apart on one surface
};

struct SurfaceLabels {
  const int32_t* labels;  // [height, width], 0 on edges
  const int64_t* sizes;   // [count] pixels of each label
  int64_t count;
};

struct Window {  // pixels of an image
  int row, column, height, width;
};

struct ForegroundRule {
  double min_inside;  // share of a surface
  float max_ratio;    // of depths within 3x3 pixels of one object, or below it
  double depth_bin;   // share of depth
  double near_mode;   // share of depth
  int grow_px;
};

#define LDO_DECLARE_FOREGROUND(isa)                                                     \
  namespace isa {                                                                       \
  std::vector<int64_t> surfaces(const DepthImage& image, const Pinhole& camera,         \
                                const SurfaceRule& rule, int32_t* labels);              \
  /* False for labels that have no size. */                                             \
  bool foreground(const DepthImage& image, double focal_px, const SurfaceLabels& found, \
                  const Window& window, const ForegroundRule& rule, uint8_t* mask);     \
  }
LDO_DECLARE_FOREGROUND(baseline)
LDO_DECLARE_FOREGROUND(avx2)
LDO_DECLARE_FOREGROUND(avx512)
#undef LDO_DECLARE_FOREGROUND

}  // namespace ldo
