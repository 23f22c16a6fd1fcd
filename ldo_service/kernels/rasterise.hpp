// Images of a map of 3D Gaussians, seen by a pinhole camera. Interface; no instruction set here.
#pragma once
#include <cstdint>

namespace ldo {

// One Gaussian is one row of 16 floats, one cache line.
constexpr int kRowFloats = 16;
enum RowField {
  kMean = 0,      // x y z, metres, map frame
  kLogScale = 3,  // log of the standard deviations in metres
  kQuat = 6,      // w x y z, rotates the Gaussian's axes to the map frame; any length
  kOpacity = 10,  // logit
  kColor = 11,    // r g b
  kFields = 14,   // the rest is unused
};

struct View {
  float T_camera_map[12];  // row-major 3x4
  float fx, fy, cx, cy;    // pixels; pixel centres at integers
  int width, height;
};

struct Images {         // row-major, height x width
  float* color;         // 3 floats a pixel, background black
  float* depth;         // sum of weight * z, metres: divide by opacity for a mean
  float* median_depth;  // z where the transmittance falls below one half; 0 where it never does
  float* opacity;       // 1 - transmittance
};

#define LDO_DECLARE_RASTERISE(isa)                                                         \
  namespace isa {                                                                          \
  void rasterise(const float* rows, int64_t n, const View& view, int threads, Images out); \
  }
LDO_DECLARE_RASTERISE(baseline)
LDO_DECLARE_RASTERISE(avx2)
LDO_DECLARE_RASTERISE(avx512)
#undef LDO_DECLARE_RASTERISE

}  // namespace ldo
