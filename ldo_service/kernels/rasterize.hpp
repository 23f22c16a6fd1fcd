// Interface of the rasterizer, which renders a map of 3D Gaussians for a pinhole camera. It is
// independent of the instruction set.
#pragma once
#include <cstdint>
#include <memory>

#include "adam.hpp"

namespace ldo {

// One Gaussian is one row of 16 floats, one cache line.
constexpr int kRowFloats = 16;
enum RowField {
  kMean = 0,      // x y z, meters, map frame.
  kLogScale = 3,  // Logarithms of the standard deviations in meters.
  kQuat = 6,      // w x y z of any length, rotates the Gaussian's axes to the map frame.
  kOpacity = 10,  // Logit.
  kColor = 11,    // r g b.
  kFields = 14,   // Number of fields; the other floats are unused.
};

struct View {
  float T_camera_map[12];  // Row-major 3x4.
  float fx, fy, cx, cy;    // Pixels; pixel centers at integers.
  int width, height;
  float low_pass = 0.3f;  // Variance that the image adds to each splat, px^2.
  float box = 0.0f;       // Part of low_pass that comes from binning, px^2.
};

// Bound of a block of kBlockRows consecutive rows. Keyframes add Gaussians in the order of their
// pixels, so that a block covers a small patch of surface. Blocks out of view are not read.
struct BlockBound {
  float low[3], high[3];  // Bounds of the means, meters.
  float sigma;            // Maximum standard deviation, meters.
  bool is_known = false;  // False if rows may have changed: the block is then read and measured.
};
constexpr int64_t kBlockRows = 256;

struct Gaussians {
  const float* rows;
  int64_t n;
  BlockBound* bounds;  // [ceil(n / kBlockRows)]; if null, every row is read.
};

constexpr int kTile = 16;  // Pixels.

struct Images {         // Row-major, height x width.
  float* color;         // 3 floats per pixel; the background is black.
  float* depth;         // Sum of weight * z, meters; divide by opacity for a mean.
  float* median_depth;  // z where the transmittance falls below one half; 0 where it never does.
  float* opacity;       // 1 - transmittance.
};

// Image planes that have derivatives. They are stored one after the other, each row-major height x
// width.
enum Plane { kRed, kGreen, kBlue, kDepth, kPlaneOpacity, kPlanes };

// A row of gradients has the fields of a row of Gaussians. The unused fields begin with this one:
constexpr int kWeight = kFields;  // Sum of the Gaussian's weights over the pixels, not a gradient.

// Data of one rendering that its gradients need. The next rendering reuses its memory.
class Pass {
 public:
  virtual ~Pass() = default;
  const float* rows = nullptr;  // Rows that were rendered.
  int64_t gaussians = 0, visible = 0;
  View view{};
};

// Penalty that turns needle-shaped Gaussians into discs. The following term is added to the loss:
//   weight * mean over the pixels of sum_i w_i max(0, log(longest / middle axis) - log_ratio).
// The derivative treats the w_i as constants.
struct NeedlePenalty {
  float weight, log_ratio;
};

// Maximum standard deviation of a Gaussian, in pixels of the view that it is optimized against. A
// Gaussian that grows over a wall without texture would dominate all content that appears there
// later.
struct SizeLimit {
  float most_px;
};

struct Gradients {
  uint32_t* indices;  // [visible], rows that may touch the image, ascending.
  float* rows;        // [visible, kRowFloats], their gradients.
  double* pose;       // [6], derivative by xi in T_map_camera exp(xi): rotation, then translation.
};

struct Contributions {  // Contributions to a rendering.
  uint32_t* indices;    // Same as in Gradients.
  float* weights;       // [visible], weight of each row summed over the pixels; 0 if it is hidden.
  int32_t* top;         // height x width; row with the largest weight, -1 if no row has any.
};

struct Reached {      // Rows that an Adam step reached.
  uint32_t* indices;  // Same as in Gradients.
  float* weights;     // [visible], weight of each row summed over the pixels.
  double* pose;       // Same as in Gradients.
};

// `tiles` has one byte for each tile of kTile x kTile pixels, row by row. Where it is 0, the planes
// are zero. If it is null, all tiles are rendered.
#define LDO_DECLARE_RASTERIZE(isa)                                                             \
  namespace isa {                                                                              \
  void rasterize(const Gaussians&, const View& view, int threads, Pass& memory, Images out);   \
  void contributions(Pass&, int threads, Contributions out);                                   \
  std::unique_ptr<Pass> new_pass();                                                            \
  void rasterize_planes(const Gaussians&, const View& view, const uint8_t* tiles, int threads, \
                        Pass&, float* planes);                                                 \
  void backpropagate(Pass&, const float* planes, const float* gradients, NeedlePenalty,        \
                     int threads, Gradients out);                                              \
  void descend(Pass&, const float* planes, const float* gradients, NeedlePenalty, SizeLimit,   \
               AdamRows, const AdamRates&, int threads, Reached out);                          \
  }
LDO_DECLARE_RASTERIZE(baseline)
LDO_DECLARE_RASTERIZE(avx2)
LDO_DECLARE_RASTERIZE(avx512)
#undef LDO_DECLARE_RASTERIZE

}  // namespace ldo
