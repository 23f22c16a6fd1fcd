// Labels on Gaussians: which region of an image each belongs to, what it has been seen as, and
// what its neighbours say. Interface; no instruction set here.
#pragma once
#include <cstdint>

#include "rasterize.hpp"

namespace ldo {

constexpr int kSlots = 5;  // labels that a Gaussian keeps beside background
enum Label : uint8_t { kBackground = 0, kOther = 1 };

// A distribution over labels: those of the slots, heaviest first, and background, which has the
// rest. All zero: nothing but background, and never seen.
struct LabelRow {
  float weights[kSlots];
  float evidence;      // sum of the weights of all observations, those of long ago faded
  uint16_t extent_mm;  // of the object that it was last seen as a part of
  uint8_t misses;      // keyframes since it was last seen as a part of one
  uint8_t ids[kSlots];
};
static_assert(sizeof(LabelRow) == 32);

// M regions of an image, each a box, or what of a rectangle of pixels a summed-area table says.
struct Regions {
  int64_t m;
  const float* boxes;      // [M, 4] x0 y0 x1 y1, pixels
  const float* scores;     // [M]
  const int32_t* rects;    // [M, 4] column, row, width, height; width 0: all of the box
  const int64_t* offsets;  // [M] where the table [height + 1, width + 1] begins
  const int32_t* sums;
};

struct AssignmentRule {
  bool by_iou;            // or by the share of the splat
  float min_overlap;      // of that
  float max_depth_gap_m;  // between a Gaussian and the surface that was measured
};

enum Outcome : int32_t { kUnexpected = -2, kUnmatched = -1 };

struct Assignments {  // [V] each
  int32_t* region;    // an Outcome, or the number of the region
  float* overlap;     // with it
  float* z;           // metres
};

enum Observed : int16_t { kNotSeen = -2, kMiss = -1 };

struct Observations {       // [V] each
  const int16_t* label;     // or an Observed
  const float* confidence;  // of a label
  const float* extent_m;    // of its object; of a miss, how large an object is worth missing
};

struct UpdateRule {
  bool is_corrected;
  float keep;         // lambda
  float miss_weight;  // evidence for background
  int miss_limit;
  float usual_extent_m;  // of objects, where nothing is known
  float hold_back;       // 0..1, of uncertain observations of settled Gaussians
};

struct ConsistencyRule {
  float sigma_m, radius_m, rate;
};

struct Disagreement {  // summed over Gaussians
  double literal = 0.0, expected = 0.0;
};

#define LDO_DECLARE_LABELS(isa)                                                               \
  namespace isa {                                                                             \
  void assign(const float* rows, const uint32_t* indices, int64_t v, const View& view,        \
              const float* depth_m, const Regions& regions, const AssignmentRule& rule,       \
              const Assignments& out, int threads);                                           \
  void update(LabelRow* rows, const uint32_t* indices, int64_t v, const Observations& seen,   \
              const UpdateRule& rule, int threads);                                           \
  Disagreement agree(const float* rows, LabelRow* labels, const uint32_t* indices, int64_t v, \
                     const ConsistencyRule& rule, int threads);                               \
  }
LDO_DECLARE_LABELS(baseline)
LDO_DECLARE_LABELS(avx2)
LDO_DECLARE_LABELS(avx512)
#undef LDO_DECLARE_LABELS

}  // namespace ldo
