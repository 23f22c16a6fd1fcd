// Images of a map of 3D Gaussians, seen by a pinhole camera. Interface; no instruction set here.
#pragma once
#include <cstdint>
#include <memory>

#include "adam.hpp"

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

// What is known of kBlockRows consecutive rows. Keyframes insert Gaussians in the order of their
// pixels, so that such a block is a small patch, and one that no ray of the view comes near is
// left out unread.
struct BlockBound {
  float low[3], high[3];  // of the means, metres
  float sigma;            // the largest standard deviation, metres
  bool is_known = false;  // a block whose rows may have changed is read, and measured on the way
};
constexpr int64_t kBlockRows = 256;

struct Gaussians {
  const float* rows;
  int64_t n;
  BlockBound* bounds;  // [ceil(n / kBlockRows)], or null: every row is read
};

constexpr int kTile = 16;  // pixels

struct Images {         // row-major, height x width
  float* color;         // 3 floats a pixel, background black
  float* depth;         // sum of weight * z, metres: divide by opacity for a mean
  float* median_depth;  // z where the transmittance falls below one half; 0 where it never does
  float* opacity;       // 1 - transmittance
};

// The images that gradients flow through, one after the other, row-major height x width each.
enum Plane { kRed, kGreen, kBlue, kDepth, kPlaneOpacity, kPlanes };

// A row of gradients has the fields of a row of Gaussians, and where the unused ones begin:
constexpr int kWeight = kFields;  // no gradient: the Gaussian's weights summed over the pixels

// What the gradients of one rendering need, and memory that the next rendering uses again.
class Pass {
 public:
  virtual ~Pass() = default;
  const float* rows = nullptr;  // that were rendered
  int64_t gaussians = 0, visible = 0;
  View view{};
};

// Adds weight * mean over the pixels of sum_i w_i max(0, log(longest / middle axis) - log_ratio)
// to what is differentiated, with the w_i held fixed: needles become discs.
struct NeedlePenalty {
  float weight, log_ratio;
};

// No standard deviation of a Gaussian may be longer than `most_px` where a view fits it: one that
// grows over a wall without texture outshines all that is to be seen there later.
struct SizeLimit {
  float most_px;
};

struct Gradients {
  uint32_t* indices;  // [visible] rows that the view reaches, ascending
  float* rows;        // [visible, kRowFloats] their gradients
  double* pose;       // [6] by xi in T_map_camera exp(xi): rotation, then translation
};

struct Contributions {  // to what was rendered
  uint32_t* indices;    // as above
  float* weights;       // [visible] of each row, summed over the pixels; 0: hidden
  int32_t* top;         // height x width: the row with the largest weight, -1 where none has any
};

struct Reached {      // by a step of Adam
  uint32_t* indices;  // as above
  float* weights;     // [visible] of each row, summed over the pixels
  double* pose;       // as above
};

// `tiles`, one byte for each tile of kTile x kTile pixels, row by row: where it is 0 the planes are
// zero. Null: all are wanted.
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
