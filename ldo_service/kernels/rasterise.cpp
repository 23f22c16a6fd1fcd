// Compiled once per instruction set, LDO_ISA.
#include "rasterise.hpp"

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
  Buffer<uint32_t> touched;  // [lists.splats] per splat of a tile: the blocks that it reaches
  Buffer<uint32_t> blended;  // [tiles, kBlocks] splats
  Buffer<float> sums;        // [lists.splats, kSumFloats]

  int64_t size_of_tile(int64_t tile) const {
    const bool exists = tile < static_cast<int64_t>(lists.columns) * lists.rows;
    return exists ? lists.start[tile + 1] - lists.start[tile] : 0;
  }
  TileRecord record(int64_t tile) {
    return {touched.data() + lists.start[tile], blended.data() + tile * kBlocks};
  }
};

template <class F>
void each_tile(const TileLists& lists, Team& team, const F& f) {
  team.each(static_cast<int64_t>(lists.columns) * lists.rows, [&](int64_t tile) {
    const uint32_t start = lists.start[tile];
    f(tile, static_cast<int>(tile % lists.columns), static_cast<int>(tile / lists.columns),
      lists.splats.data() + start, static_cast<int64_t>(lists.start[tile + 1] - start));
  });
}

// Sums over the tiles of each splat in turn, in the order of the tiles.
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
  static constexpr int kAhead = 64;  // pairs: they lie in the order of the tiles
  const float* sums_of(uint32_t slot) const { return sums_ + int64_t{slot} * kSumFloats; }
  const float* sums_;
  const uint32_t *slot_, *end_;
};

// The splats of one piece of the Gaussians, sixteen at a time.
void differentiate_piece(const float* rows, const RecordedPass& pass,
                         const ProjectionGradient& differentiate, int64_t piece,
                         const Gradients& out, PoseSums& pose) {
  const PieceCounts& counts = pass.splats.counts[piece];
  SumsOverTiles sum_over_tiles(pass, piece);
  for (int64_t done = 0; done < counts.splats; done += kLanes) {
    const int count = static_cast<int>(std::min<int64_t>(kLanes, counts.splats - done));
    const int64_t first = piece * kProjectionPiece + done, to = counts.first_splat + done;
    const uint32_t* gaussians = &pass.splats.gaussians[first];
    Floats matrix[kLanes], sums[kLanes], gradient[kLanes];
    for (int k = 0; k < kLanes; ++k) {  // the last is repeated, with no gradient
      matrix[k] =
          Floats::load(rows + static_cast<int64_t>(gaussians[std::min(k, count - 1)]) * kRowFloats);
      sums[k] = k < count ? sum_over_tiles.next(pass.splats.tiles[first + k]) : Floats(0.0f);
    }
    transpose(matrix);
    transpose(sums);
    alignas(64) float columns[kRowFloats][kLanes];
    for (int j = 0; j < kRowFloats; ++j) matrix[j].store(columns[j]);
    differentiate(columns, sums, gradient, pose);
    transpose(gradient);
    for (int k = 0; k < count; ++k) gradient[k].store(out.rows + (to + k) * kRowFloats);
    std::copy(gaussians, gaussians + count, out.indices + to);
  }
}

}  // namespace

void rasterise(const float* rows, int64_t n, const View& view, int threads, Pass& memory,
               Images out) {
  auto& pass = static_cast<RecordedPass&>(memory);
  VisibleSplats& visible = pass.splats;
  TileLists& lists = pass.lists;
  Team team(threads);
  project(rows, n, view, team, visible);
  list_by_tile(visible, view, team, lists);
  each_tile(lists, team, [&](int64_t, int column, int row, const uint32_t* list, int64_t size) {
    Tile tile(column, row, view);
    tile.blend<true>(visible.splats.data(), list, size);
    tile.store(out);
  });
}

std::unique_ptr<Pass> new_pass() { return std::make_unique<RecordedPass>(); }

void rasterise_planes(const float* rows, int64_t n, const View& view, int threads, Pass& opaque,
                      float* planes) {
  auto& pass = static_cast<RecordedPass&>(opaque);
  Team team(threads);
  project(rows, n, view, team, pass.splats);
  list_by_tile(pass.splats, view, team, pass.lists);
  pass.touched.resize(pass.lists.splats.size());
  pass.blended.resize(static_cast<size_t>(pass.lists.columns) * pass.lists.rows * kBlocks);
  each_tile(pass.lists, team,
            [&](int64_t t, int column, int row, const uint32_t* list, int64_t size) {
              Tile tile(column, row, view);
              tile.blend(pass.splats.splats.data(), list, size, pass.record(t));
              tile.store_planes(planes);
            });
  pass.gaussians = n;
  pass.visible = pass.splats.count;
  pass.view = view;
}

void backpropagate(const float* rows, Pass& opaque, const float* planes, const float* gradients,
                   NeedlePenalty penalty, int threads, Gradients out) {
  auto& pass = static_cast<RecordedPass&>(opaque);
  Team team(threads);
  pass.sums.resize(pass.lists.splats.size() * kSumFloats);
  each_tile(pass.lists, team,
            [&](int64_t t, int column, int row, const uint32_t* list, int64_t size) {
              TileGradient differentiate(column, row, pass.view, planes, gradients);
              const int64_t ahead = pass.size_of_tile(t + 1);
              differentiate(pass.splats.splats.data(), list, size, ahead, pass.record(t),
                            pass.sums.data() + pass.lists.start[t] * int64_t{kSumFloats});
            });

  const int64_t pieces = pass.splats.counts.size();
  Buffer<PoseSums> poses(pieces);
  const ProjectionGradient differentiate(pass.view, penalty);
  team.each(pieces, [&](int64_t piece) {
    PoseSums pose;
    differentiate_piece(rows, pass, differentiate, piece, out, pose);
    poses[piece] = pose;
  });
  std::fill(out.pose, out.pose + 6, 0.0);
  for (int64_t piece = 0; piece < pieces; ++piece) {
    const auto& [rotation, translation] = poses[piece];
    const Floats lanes[6] = {rotation.x,    rotation.y,    rotation.z,
                             translation.x, translation.y, translation.z};
    for (int k = 0; k < 6; ++k) out.pose[k] += sum(lanes[k]);
  }
}

}  // namespace ldo::LDO_ISA
