// Motion of Gaussians with their anchor keyframes, compiled once per instruction set (LDO_ISA).
#include "motion.hpp"

#include <algorithm>

#include "parallel.hpp"

namespace ldo::LDO_ISA {
namespace {

// Return the index of the anchor among the keyframes, or -1.
int64_t index_of(const Motions& motions, int32_t anchor) {
  const int64_t* end = motions.keyframes + motions.count;
  const int64_t* found = std::lower_bound(motions.keyframes, end, int64_t{anchor});
  return found != end && *found == anchor ? found - motions.keyframes : -1;
}

// mean <- R mean + t,  rotation <- q rotation (Hamilton product)
void move_row(float* row, const double* T, const double* q) {
  const double x = row[0], y = row[1], z = row[2];
  for (int i = 0; i < 3; ++i) {
    const double* line = T + 4 * i;
    row[i] = static_cast<float>(line[0] * x + line[1] * y + line[2] * z + line[3]);
  }
  const double w = row[6], i = row[7], j = row[8], k = row[9];
  row[6] = static_cast<float>(q[0] * w - q[1] * i - q[2] * j - q[3] * k);
  row[7] = static_cast<float>(q[0] * i + q[1] * w + q[2] * k - q[3] * j);
  row[8] = static_cast<float>(q[0] * j - q[1] * k + q[2] * w + q[3] * i);
  row[9] = static_cast<float>(q[0] * k + q[1] * j - q[2] * i + q[3] * w);
}

}  // namespace

void move_rows(float* rows, const int32_t* anchors, int64_t n, const Motions& motions,
               int threads) {
  constexpr int64_t kJobRows = 16384;
  Team(threads).each((n + kJobRows - 1) / kJobRows, [&](int64_t job) {
    // Gaussians of one keyframe are mostly in adjacent rows, so the last index usually still holds.
    int32_t anchor = -1;
    int64_t which = -1;
    for (int64_t r = job * kJobRows; r < std::min(n, (job + 1) * kJobRows); ++r) {
      if (anchors[r] != anchor || r == job * kJobRows) {
        anchor = anchors[r];
        which = index_of(motions, anchor);
      }
      if (which >= 0)
        move_row(rows + r * kMotionFloats, motions.T_new_old + 16 * which,
                 motions.quaternion + 4 * which);
    }
  });
}

}  // namespace ldo::LDO_ISA
