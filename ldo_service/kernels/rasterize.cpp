// Rasterizer, compiled once per instruction set (macro LDO_ISA).
#include "rasterize.hpp"

#include "adam_step.hpp"
#include "contributions.hpp"
#include "projection_gradient.hpp"

namespace ldo::LDO_ISA {
namespace {

struct RecordedPass final : Pass {
  RecordedPass() {
    splats.splats.keep();
    lists.splats.keep();
    lists.slots.keep();
    touched.keep();
    sums.keep();
  }
  VisibleSplats splats;
  TileLists lists;
  Buffer<uint32_t> touched;  // [lists.splats], blocks that each splat of a tile reaches.
  Buffer<uint32_t> blended;  // [tiles, kBlocks], number of splats that each block blended.
  Buffer<float> sums;        // [lists.splats, kSumFloats].

  int64_t size_of_tile(int64_t tile) const {
    const bool exists = tile < static_cast<int64_t>(lists.columns) * lists.rows;
    return exists ? lists.start[tile + 1] - lists.start[tile] : 0;
  }
  // Return the entry of `sums`, of `floats` values, that all pairs with unwanted tiles share. It
  // holds zeros.
  float* sums_of_nothing(int floats) {
    return &sums[int64_t{lists.start[lists.start.size() - 1]} * floats];
  }
  TileRecord record(int64_t tile) {
    return {touched.data() + lists.start[tile], blended.data() + tile * kBlocks};
  }
};

// Call f for every tile. A job takes a few adjacent tiles, because they share splats and cache
// lines of the image, and each tile prefetches what the next tile reads.
template <class F>
void each_tile(const TileLists& lists, Team& team, const F& f) {
  constexpr int64_t kJobTiles = 4;
  const int64_t tiles = static_cast<int64_t>(lists.columns) * lists.rows;
  team.each((tiles + kJobTiles - 1) / kJobTiles, [&](int64_t job) {
    for (int64_t tile = job * kJobTiles; tile < std::min(tiles, (job + 1) * kJobTiles); ++tile) {
      const uint32_t start = lists.start[tile];
      f(tile, static_cast<int>(tile % lists.columns), static_cast<int>(tile / lists.columns),
        lists.splats.data() + start, static_cast<int64_t>(lists.start[tile + 1] - start));
    }
  });
}

// Iterator over the splats of a piece. `next` returns the sums of the next splat over its tiles,
// added in the order of the tiles.
class SumsOverTiles {
 public:
  SumsOverTiles(const RecordedPass& pass, int64_t piece)
      : sums_(pass.sums.data()),
        slot_(&pass.lists.slots[pass.splats.counts[piece].first_pair]),
        end_(slot_ + pass.splats.counts[piece].pairs) {}

  [[gnu::always_inline]] inline Floats next(const TileRange& range) {
    Floats sum = 0.0f;
    for (const uint32_t* end = slot_ + area(range); slot_ < end; ++slot_) {
      if (slot_ + kAhead < end_) __builtin_prefetch(sums_of(slot_[kAhead]));
      sum = sum + Floats::load(sums_of(*slot_));
    }
    return sum;
  }

 private:
  // Number of pairs to prefetch ahead. The sums are stored tile by tile, so the sums of successive
  // pairs of a splat lie far apart.
  static constexpr int kAhead = 64;
  const float* sums_of(uint32_t slot) const { return sums_ + int64_t{slot} * kSumFloats; }
  const float* sums_;
  const uint32_t *slot_, *end_;
};

// Call take(position among the visible, row number, gradient) for the splats of one piece of the
// Gaussians. They are differentiated sixteen at a time.
template <class Take>
void differentiate_piece(const RecordedPass& pass, const ProjectionGradient& differentiate,
                         int64_t piece, PoseSums& pose, const Take& take) {
  const PieceCounts& counts = pass.splats.counts[piece];
  SumsOverTiles sum_over_tiles(pass, piece);
  for (int64_t done = 0; done < counts.splats; done += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, counts.splats - done));
    const int64_t first = piece * kProjectionPiece + done, to = counts.first_splat + done;
    const uint32_t* gaussians = &pass.splats.gaussians[first];
    Floats matrix[kLanes], sums[kLanes], gradient[kLanes];
    for (int k = 0; k < kLanes; ++k) {  // Spare lanes repeat the last row, with zero sums.
      matrix[k] = Floats::load(pass.rows + int64_t{gaussians[std::min(k, count - 1)]} * kRowFloats);
      sums[k] = k < count ? sum_over_tiles.next(pass.splats.tiles[first + k]) : Floats(0.0f);
    }
    transpose(matrix);
    transpose(sums);
    alignas(64) float columns[kRowFloats][kLanes];
    for (int j = 0; j < kRowFloats; ++j) matrix[j].store(columns[j]);
    differentiate(columns, sums, gradient, pose);
    transpose(gradient);
    for (int k = 0; k < count; ++k) take(to + k, gaussians[k], gradient[k]);
  }
}

// Project, sort and blend, keep the record, and pass each finished tile to `store`.
template <bool WithMedian, class Store>
void blend_tiles(const Gaussians& gaussians, const View& view, const uint8_t* wanted, int threads,
                 Pass& opaque, const Store& store) {
  auto& pass = static_cast<RecordedPass&>(opaque);
  Team team(threads);
  const TileGrid grid(view, wanted);
  project(gaussians, view, grid, team, pass.splats);
  list_by_tile(pass.splats, grid, team, pass.lists);
  pass.touched.resize(pass.lists.splats.size());
  pass.blended.resize(static_cast<size_t>(pass.lists.columns) * pass.lists.rows * kBlocks);
  each_tile(pass.lists, team,
            [&](int64_t t, int column, int row, const uint32_t* list, int64_t size) {
              Tile tile(column, row, view);
              tile.blend<WithMedian>(pass.splats.splats.data(), list, size, pass.record(t));
              store(tile);
            });
  pass.rows = gaussians.rows;
  pass.gaussians = gaussians.n;
  pass.visible = pass.splats.count;
  pass.view = view;
}

void differentiate_tiles(RecordedPass& pass, const float* planes, const float* gradients,
                         Team& team) {
  pass.sums.resize(pass.lists.splats.size() * kSumFloats);
  std::fill_n(pass.sums_of_nothing(kSumFloats), kSumFloats, 0.0f);
  each_tile(pass.lists, team,
            [&](int64_t t, int column, int row, const uint32_t* list, int64_t size) {
              TileGradient differentiate(column, row, pass.view, planes, gradients);
              const int64_t ahead = pass.size_of_tile(t + 1);
              differentiate(pass.splats.splats.data(), list, size, ahead, pass.record(t),
                            pass.sums.data() + pass.lists.start[t] * int64_t{kSumFloats});
            });
}

void add_up(const Buffer<PoseSums>& poses, double* out) {
  std::fill(out, out + 6, 0.0);
  for (size_t piece = 0; piece < poses.size(); ++piece) {
    const auto& [rotation, translation] = poses[piece];
    const Floats lanes[6] = {rotation.x,    rotation.y,    rotation.z,
                             translation.x, translation.y, translation.z};
    for (int k = 0; k < 6; ++k) out[k] += sum(lanes[k]);
  }
}

// Limit on the standard deviations of a Gaussian in a view.
class SizeBound {
 public:
  SizeBound(const View& view, SizeLimit limit)
      : view_(view), per_depth_(limit.most_px / std::max(view.fx, view.fy)) {}
  void operator()(float* row) const {
    const float *forward = view_.T_camera_map + 8, *mean = row + kMean;
    const float z = forward[0] * mean[0] + forward[1] * mean[1] + forward[2] * mean[2] + forward[3];
    const float most = std::log(per_depth_ * std::max(z, kNearPlane));
    for (int k = 0; k < 3; ++k) row[kLogScale + k] = std::min(row[kLogScale + k], most);
  }

 private:
  const View view_;
  const float per_depth_;
};

// Convert the derivatives by the images to derivatives by the rows, and pass those to `take` one by
// one.
template <class Take>
void differentiate(Pass& opaque, const float* planes, const float* gradients, NeedlePenalty penalty,
                   int threads, double* by_pose, const Take& take) {
  auto& pass = static_cast<RecordedPass&>(opaque);
  Team team(threads);
  differentiate_tiles(pass, planes, gradients, team);
  Buffer<PoseSums> poses(pass.splats.counts.size());
  const ProjectionGradient differentiate(pass.view, penalty);
  team.each(poses.size(), [&](int64_t piece) {
    PoseSums pose;
    differentiate_piece(pass, differentiate, piece, pose, take);
    poses[piece] = pose;
  });
  add_up(poses, by_pose);
}

}  // namespace

void rasterize(const Gaussians& gaussians, const View& view, int threads, Pass& pass, Images out) {
  blend_tiles<true>(gaussians, view, nullptr, threads, pass,
                    [&](const Tile& tile) { tile.store(out); });
}

void rasterize_planes(const Gaussians& gaussians, const View& view, const uint8_t* tiles,
                      int threads, Pass& pass, float* planes) {
  blend_tiles<false>(gaussians, view, tiles, threads, pass,
                     [&](const Tile& tile) { tile.store_planes(planes); });
}

std::unique_ptr<Pass> new_pass() { return std::make_unique<RecordedPass>(); }

void contributions(Pass& opaque, int threads, Contributions out) {
  auto& pass = static_cast<RecordedPass&>(opaque);
  Team team(threads);
  pass.sums.resize(pass.lists.splats.size());
  *pass.sums_of_nothing(1) = 0.0f;
  each_tile(pass.lists, team,
            [&](int64_t t, int column, int row, const uint32_t* list, int64_t size) {
              const TileContributions contribute(column, row, pass.view);
              contribute(pass.splats, list, size, pass.record(t),
                         pass.sums.data() + pass.lists.start[t], out.top);
            });
  team.each(pass.splats.counts.size(), [&](int64_t piece) {
    const PieceCounts& counts = pass.splats.counts[piece];
    const uint32_t* slot = &pass.lists.slots[counts.first_pair];
    for (int64_t k = 0; k < counts.splats; ++k) {
      const int64_t splat = piece * kProjectionPiece + k, place = counts.first_splat + k;
      out.indices[place] = pass.splats.gaussians[splat];
      out.weights[place] = 0.0f;
      for (const uint32_t* end = slot + area(pass.splats.tiles[splat]); slot < end; ++slot)
        out.weights[place] += pass.sums[*slot];
    }
  });
}

void backpropagate(Pass& pass, const float* planes, const float* gradients, NeedlePenalty penalty,
                   int threads, Gradients out) {
  differentiate(pass, planes, gradients, penalty, threads, out.pose,
                [&](int64_t place, uint32_t row, Floats gradient) {
                  out.indices[place] = row;
                  gradient.store(out.rows + place * kRowFloats);
                });
}

// The step runs in place, because no row is read again once its gradient is known.
void descend(Pass& pass, const float* planes, const float* gradients, NeedlePenalty penalty,
             SizeLimit size, AdamRows rows, const AdamRates& rates, int threads, Reached out) {
  const AdamStep step(rows, rates);
  const SizeBound bound(pass.view, size);
  differentiate(pass, planes, gradients, penalty, threads, out.pose,
                [&](int64_t place, uint32_t row, Floats gradient) {
                  alignas(64) float fields[kRowFloats];
                  gradient.store(fields);
                  out.indices[place] = row;
                  out.weights[place] = fields[kWeight];
                  if (step(row, gradient)) bound(rows.parameters + int64_t{row} * kRowFloats);
                });
}

}  // namespace ldo::LDO_ISA
