// Interface of the labels of Gaussians: assignment to image regions, update by observations and
// consistency of neighbors. It is independent of the instruction set.
#pragma once
#include <cstdint>

#include "rasterize.hpp"

namespace ldo {

constexpr int kSlots = 5;  // Labels per Gaussian, background excluded.
enum Label : uint8_t { kBackground = 0, kOther = 1 };

// Distribution over labels: the labels in the slots, by descending weight; background has the rest
// of the probability. If all fields are zero, the Gaussian is background and was never observed.
struct LabelRow {
  float weights[kSlots];
  float evidence;      // Sum of the weights of all observations; older observations are faded.
  uint16_t extent_mm;  // Extent of the object that the Gaussian was last observed as a part of.
  uint8_t misses;      // Keyframes with a miss since that observation.
  uint8_t ids[kSlots];
};
static_assert(sizeof(LabelRow) == 32);

// M regions of an image. Each is a box, or a mask given by the summed-area table of a rectangle.
struct Regions {
  int64_t m;
  const float* boxes;      // [M, 4], x0 y0 x1 y1, pixels.
  const float* scores;     // [M].
  const int32_t* rects;    // [M, 4], column, row, width, height; width 0 selects the whole box.
  const int64_t* offsets;  // [M], start of each table [height + 1, width + 1] in `sums`.
  const int32_t* sums;
};

struct AssignmentRule {
  bool by_iou;            // Overlap is the IoU; if false, it is the covered fraction of the splat.
  float min_overlap;      // Minimum overlap of an assigned region.
  float max_depth_gap_m;  // Maximum distance of a Gaussian behind the measured surface.
  float max_front_gap_m;  // Maximum distance in front of it; infinite if there is no limit.
};

enum Outcome : int32_t { kUnexpected = -2, kUnmatched = -1 };

struct Assignments {  // Each array is [V].
  int32_t* region;    // An Outcome, or the number of the region.
  float* overlap;     // Overlap with that region.
  float* z;           // Meters.
};

enum Observed : int16_t { kNotSeen = -2, kMiss = -1 };

struct Observations {       // Each array is [V].
  const int16_t* label;     // Label, or an Observed value.
  const float* confidence;  // Confidence of a label.
  // Extent of the label's object; of a miss, the minimum extent of an object that counts as missed.
  const float* extent_m;
};

struct UpdateRule {
  bool is_corrected;     // Use the corrected moving average; if false, the paper's.
  float keep;            // Lambda of the moving average.
  float miss_weight;     // Weight of a miss as an observation of background, 0..1.
  int miss_limit;        // Misses in a row that reset a Gaussian, for the paper's average.
  float usual_extent_m;  // Extent of objects where it is unknown.
  float hold_back;       // Damping of uncertain observations of Gaussians with low entropy, 0..1.
};

// Length scale of the weights, maximum distance of a neighbor, and size of the step, 0..1.
struct ConsistencyRule {
  float sigma_m, radius_m, rate;
};

// Disagreement between neighbors, as weighted sums over all pairs. `literal` counts pairs with
// different top labels. `expected` is the probability that two labels drawn from the distributions
// of a pair differ.
struct Disagreement {
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
