// Interface of the smooth surfaces of a depth image and of the object in a box. It is independent
// of the instruction set. Images are dense and row-major, pixel centers at integers. Depth that is
// not above 0 is missing.
#pragma once
#include <cstdint>
#include <vector>

namespace ldo {

struct DepthImage {
  const float* depth_m;  // [height, width], meters.
  int width, height;
};

struct Pinhole {
  double fx, fy, cx, cy;  // Pixels.
};

struct SurfaceRule {
  float max_ratio;   // Maximum ratio of depths within 3x3 pixels of one surface.
  float min_cosine;  // Minimum cosine of normals 4 px apart on one surface.
};

struct SurfaceLabels {
  const int32_t* labels;  // [height, width], 0 on edges.
  const int64_t* sizes;   // [count], pixels of each label.
  int64_t count;
};

struct Window {  // Window of an image, in pixels.
  int row, column, height, width;
};

struct ForegroundRule {
  double min_inside;  // Minimum fraction of a surface's pixels inside the box.
  float max_ratio;    // Maximum ratio of depths within 3x3 pixels of one object.
  double depth_bin;   // Width of a bin of the depth mode, fraction of depth.
  double near_mode;   // Maximum distance from the mode, fraction of depth.
  int grow_px;
};

#define LDO_DECLARE_FOREGROUND(isa)                                                     \
  namespace isa {                                                                       \
  std::vector<int64_t> surfaces(const DepthImage& image, const Pinhole& camera,         \
                                const SurfaceRule& rule, int32_t* labels);              \
  /* Return false if a label has no entry in `sizes`. */                                \
  bool foreground(const DepthImage& image, double focal_px, const SurfaceLabels& found, \
                  const Window& window, const ForegroundRule& rule, uint8_t* mask);     \
  }
LDO_DECLARE_FOREGROUND(baseline)
LDO_DECLARE_FOREGROUND(avx2)
LDO_DECLARE_FOREGROUND(avx512)
#undef LDO_DECLARE_FOREGROUND

}  // namespace ldo
