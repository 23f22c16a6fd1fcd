// Interface of the loss between a rendering and a frame and of its derivative by every pixel. It is
// independent of the instruction set.
#pragma once
#include <cstdint>

namespace ldo {

struct LossWeights {
  float l1, d_ssim, depth;
};

struct LossInput {
  int width, height;
  const float* planes;    // Red, green, blue, depth in meters, opacity; height x width each.
  const uint8_t* color;   // Red, green and blue planes of the frame, 0..255.
  const float* depth;     // Depth of the frame in meters, 0 where not measured.
  const uint8_t* mask;    // Pixels with 0 do not count; null counts all pixels.
  const float* exposure;  // Gains of the three channels, then biases.
  LossWeights weights;
};

struct LossOutput {
  float* gradients;          // Derivatives by the five planes.
  double l1, d_ssim, depth;  // Means, without their weights.
  double squared_error;      // Mean over pixels and channels.
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
