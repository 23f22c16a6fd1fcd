// Label kernels, compiled once per instruction set (macro LDO_ISA).
#include <vector>

#include "assignment.hpp"
#include "consistency.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {

constexpr int64_t kJob = 4096;  // Gaussians per job.

template <class F>
void each_job(int64_t v, int threads, const F& f) {
  Team(threads).each((v + kJob - 1) / kJob,
                     [&](int64_t job) { f(job * kJob, std::min(v, (job + 1) * kJob)); });
}

void assign(const float* rows, const uint32_t* indices, int64_t v, const View& view,
            const float* depth_m, const Regions& regions, const AssignmentRule& rule,
            const Assignments& out, int threads) {
  const Candidates candidates(regions);
  const SplatBoxer boxes_of(view, depth_m, rule);
  each_job(v, threads, [&](int64_t begin, int64_t end) {
    for (int64_t first = begin; first < end; first += kLanes) {
      const int count = static_cast<int>(std::min<int64_t>(kLanes, end - first));
      SplatBoxes splats;
      boxes_of(rows, indices + first, count, splats);
      Contest contest(splats.expected, count, out.region + first, out.overlap + first);
      candidates.each_near(
          splats, [&](int32_t j, const Region& region) { contest.enter(j, region, splats, rule); });
      Floats::load(splats.z).store_first(out.z + first, count);
    }
  });
}

void update(LabelRow* rows, const uint32_t* indices, int64_t v, const Observations& seen,
            const UpdateRule& rule, int threads) {
  const LabelUpdate look(rule);
  each_job(v, threads, [&](int64_t begin, int64_t end) {
    for (int64_t i = begin; i < end; ++i)
      look(rows[indices[i]], seen.label[i], seen.confidence[i], seen.extent_m[i]);
  });
}

Disagreement agree(const float* rows, LabelRow* labels, const uint32_t* indices, int64_t v,
                   const ConsistencyRule& rule, int threads) {
  constexpr int64_t kJobVoxels = 256, kAhead = 8;
  const Voxels voxels(rows, indices, v, 2.0f * rule.sigma_m);
  Buffer<LabelRow> before(v);
  for (int64_t i = 0; i < v; ++i) before[i] = labels[indices[i]];
  // The Gaussians of all other voxels and their neighbors are background, so they agree.
  const auto active = voxels.about([&](uint32_t place) { return before[place].weights[0] > 0.0f; });
  const ConsistencyStep step(rule);
  const int64_t n = static_cast<int64_t>(active.size());
  std::vector<Disagreement> sums((n + kJobVoxels - 1) / kJobVoxels);
  Team(threads).each(static_cast<int64_t>(sums.size()), [&](int64_t job) {
    for (int64_t a = job * kJobVoxels; a < std::min(n, (job + 1) * kJobVoxels); ++a) {
      uint32_t places[kLanes];
      const int count = voxels.around(active[a], places);
      const Neighbors16 around(rows, indices, before.data(), places, count);
      const bool is_bare = around.labels() == 1;
      const uint32_t* members = voxels.begin(active[a]);
      const int64_t last = voxels.count(active[a]) - 1;
      for (int64_t k = 0; k <= last; ++k) {
        // Members lie apart in memory, so they are prefetched some iterations before they are read.
        const uint32_t i = members[k], later = indices[members[std::min(k + kAhead, last)]];
        __builtin_prefetch(rows + static_cast<int64_t>(later) * kRowFloats);
        __builtin_prefetch(labels + later, 1);
        if (is_bare && before[i].weights[0] == 0.0f) continue;  // Every label here is background.
        const float* mean = rows + static_cast<int64_t>(indices[i]) * kRowFloats;
        const Floats weights = around.weights(mean, k < kOwn ? static_cast<int>(k) : -1, rule);
        step(around, weights, before[i], labels[indices[i]], sums[job]);
      }
    }
  });
  Disagreement out;
  for (const Disagreement& part : sums) {
    out.literal += part.literal;
    out.expected += part.expected;
  }
  return out;
}

}  // namespace ldo::LDO_ISA
