// How far a rendering is from a frame, and its derivative by every pixel. No instruction set here.
#pragma once
#include <cstdint>

namespace ldo {

struct LossWeights {
  float l1, d_ssim, depth;
};

struct LossInput {
  int width, height;
  const float* planes;    // red, green, blue, depth in metres, opacity; height x width each
  const uint8_t* color;   // of the frame: red, green, blue planes, 0..255
  const float* depth;     // of the frame, metres, 0 where not measured
  const uint8_t* mask;    // 0: the pixel does not count; null: all do
  const float* exposure;  // gains of the three channels, then biases
  LossWeights weights;
};

struct LossOutput {
  float* gradients;          // by the five planes
  double l1, d_ssim, depth;  // means, without their weights
  double squared_error;      // mean over pixels and channels
};

#define LDO_DECLARE_LOSS(isa)                                         \
  namespace isa {                                                     \
  void image_loss(const LossInput& in, int threads, LossOutput& out); \
  }
LDO_DECLARE_LOSS(baseline)
LDO_DECLARE_LOSS(avx2)
LDO_DECLARE_LOSS(avx512)
#undef LDO_DECLARE_LOSS

}  // namespace ldo
