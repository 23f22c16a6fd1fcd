// Lists of the splats that each tile of 16x16 pixels blends, in blending order.
#pragma once
#include "culling.hpp"
#include "radix_sort.hpp"

namespace ldo::LDO_ISA {

constexpr int64_t kPieceBlocks = 16;
constexpr int64_t kProjectionPiece = kPieceBlocks * kBlockRows;  // Gaussians.

struct PieceCounts {  // Number of splats of a piece, and number of their (splat, tile) pairs.
  int64_t splats;
  uint32_t pairs;
  int64_t first_splat = 0, first_pair = 0;  // Positions among all pieces.
};

// Splats of a rendering, piece by piece, and their order by depth.
struct VisibleSplats {
  Buffer<uint32_t> blocks;  // Blocks of rows that may be in view, ascending.
  Buffer<Splat> splats;     // Splats of piece p of the blocks start at p * kProjectionPiece.
  Buffer<TileRange> tiles;
  Buffer<uint32_t> gaussians;  // Row of each splat.
  Buffer<PieceCounts> counts;  // Counts of each piece.
  // Sorted by (z, index of the Gaussian); key = bits of z, value = position in splats.
  Buffer<Keyed> depths;
  Buffer<Keyed> spare;  // Memory for sorting.
  int64_t count = 0;
  int64_t pairs = 0;  // Pairs of a splat and a tile of its range.

  int64_t first_pair(uint32_t splat) const {
    return counts[splat / kProjectionPiece].first_pair + tiles[splat].first_pair;
  }
};

// Tiles of an image; all or some of them are wanted.
struct TileGrid {
  TileGrid(const View& view, const uint8_t* wanted)
      : columns((view.width + kTile - 1) / kTile),
        rows((view.height + kTile - 1) / kTile),
        wanted_(wanted) {}
  int64_t count() const { return static_cast<int64_t>(columns) * rows; }
  bool wants(uint32_t tile) const { return wanted_ == nullptr || wanted_[tile] != 0; }
  bool wants_any(const TileRange& range) const {
    if (wanted_ == nullptr) return true;
    for (int y = range.y0; y <= range.y1; ++y)
      for (int x = range.x0; x <= range.x1; ++x)
        if (wanted_[static_cast<int64_t>(y) * columns + x] != 0) return true;
    return false;
  }
  const int columns, rows;

 private:
  const uint8_t* wanted_;
};

// Projection of one piece. It appends the visible splats of the blocks, and measures the blocks
// whose bound is unknown.
class PieceProjection {
 public:
  PieceProjection(const Gaussians& gaussians, const Projection& project, const TileGrid& grid,
                  int64_t piece, VisibleSplats& out)
      : gaussians_(gaussians),
        project_(project),
        grid_(grid),
        out_(out),
        place_(piece * kProjectionPiece) {}

  PieceCounts operator()(const uint32_t* blocks, int64_t count) {
    const int64_t first = place_;
    for (int64_t i = 0; i < count; ++i) {
      BlockBound* bound = gaussians_.bounds == nullptr ? nullptr : &gaussians_.bounds[blocks[i]];
      if (bound == nullptr || bound->is_known)
        project_block(blocks[i], [](const auto&, int) {});
      else
        *bound = measured(blocks[i]);
    }
    return {place_ - first, pairs_};
  }

 private:
  BlockBound measured(uint32_t block) {
    Measure measure;
    project_block(block, [&](const auto& columns, int count) { measure.add(columns, count); });
    return measure.bound();
  }

  template <class Look>
  void project_block(uint32_t block, const Look& look) {
    const int64_t begin = block * kBlockRows, end = std::min(begin + kBlockRows, gaussians_.n);
    for (int64_t i = begin; i < end; i += kLanes) {
      const int count = static_cast<int>(std::min<int64_t>(kLanes, end - i));
      transpose_rows(gaussians_.rows + i * kRowFloats, count, columns_);
      look(columns_, count);
      project_(columns_, splats_);
      for (uint32_t rest = splats_.drawn; rest != 0; rest &= rest - 1)
        append(__builtin_ctz(rest), static_cast<uint32_t>(i));
    }
  }

  [[gnu::always_inline]] inline void append(int k, uint32_t first_row) {
    const SplatColumns& s = splats_;
    TileRange& tiles = out_.tiles[place_];
    if (!tiles_of(s, k, project_.view, tiles) || !grid_.wants_any(tiles)) return;
    tiles.first_pair = pairs_;
    pairs_ += area(tiles);
    out_.splats[place_] = {s.u[k],
                           s.v[k],
                           s.a[k],
                           s.b[k],
                           s.c[k],
                           s.log2_opacity[k],
                           s.x_slope[k],
                           s.y_slope[k],
                           {columns_[kColor][k], columns_[kColor + 1][k], columns_[kColor + 2][k]},
                           s.z[k]};
    out_.gaussians[place_++] = first_row + k;
  }

  const Gaussians& gaussians_;
  const Projection& project_;
  const TileGrid& grid_;
  VisibleSplats& out_;
  int64_t place_;
  uint32_t pairs_ = 0;
  alignas(64) float columns_[kRowFloats][kLanes];
  alignas(64) SplatColumns splats_;
};

// Compute the positions of the first splat and the first pair of each piece among those of all
// pieces.
inline void sum_counts(VisibleSplats& visible) {
  visible.count = visible.pairs = 0;
  for (size_t piece = 0; piece < visible.counts.size(); ++piece) {
    PieceCounts& counts = visible.counts[piece];
    counts.first_splat = visible.count;
    counts.first_pair = visible.pairs;
    visible.count += counts.splats;
    visible.pairs += counts.pairs;
  }
}

// Sort the splats by depth. Depths are positive, so their bits have the same order. At equal depth,
// the lower index comes first, because splats are in the order of the Gaussians and the sort is
// stable.
inline void order_by_depth(VisibleSplats& visible, Team& team) {
  const size_t pieces = visible.counts.size();
  Buffer<uint32_t> lowest(pieces), highest(pieces);
  visible.depths.resize(visible.count);
  visible.spare.resize(visible.count);
  Keyed* items = visible.depths.data();
  team.each(pieces, [&](int64_t piece) {
    const PieceCounts& counts = visible.counts[piece];
    uint32_t low = ~0u, high = 0;
    for (int64_t k = 0; k < counts.splats; ++k) {
      const uint32_t place = static_cast<uint32_t>(piece * kProjectionPiece + k);
      uint32_t key;
      std::memcpy(&key, &visible.splats[place].z, sizeof key);
      low = std::min(low, key);
      high = std::max(high, key);
      items[counts.first_splat + k] = {key, place};
    }
    lowest[piece] = low;
    highest[piece] = high;
  });
  if (visible.count == 0) return;
  const uint32_t low = *std::min_element(lowest.data(), lowest.data() + pieces),
                 high = *std::max_element(highest.data(), highest.data() + pieces);
  if (radix_sort(items, visible.spare.data(), visible.count, low, high, team) != items)
    std::swap(visible.depths, visible.spare);
}

inline void project(const Gaussians& gaussians, const View& view, const TileGrid& grid, Team& team,
                    VisibleSplats& out) {
  list_blocks_in_view(gaussians, view, out.blocks);
  const int64_t blocks = out.blocks.size(), n = blocks * kBlockRows;
  out.splats.resize(n);
  out.tiles.resize(n);
  out.gaussians.resize(n);
  out.counts.resize((blocks + kPieceBlocks - 1) / kPieceBlocks);
  const Projection projection(view);
  team.each(out.counts.size(), [&](int64_t piece) {
    const int64_t begin = piece * kPieceBlocks;
    PieceProjection project_piece(gaussians, projection, grid, piece, out);
    out.counts[piece] = project_piece(&out.blocks[begin], std::min(kPieceBlocks, blocks - begin));
  });
  sum_counts(out);
  order_by_depth(out, team);
}

// Number of splats to prefetch ahead, while the splats of a tile are read in the order of its list.
constexpr int kPrefetchAhead = 24;

struct TileLists {
  int columns = 0, rows = 0;
  Buffer<uint32_t> start;   // [columns * rows + 1], positions in splats.
  Buffer<uint32_t> splats;  // Front to back within a tile; kPrefetchAhead zeros at the end.
  // Position in `splats` of each pair of a splat and a tile. Splats are ordered as in
  // VisibleSplats, and the tiles of their ranges row by row. All pairs with a tile that is not
  // wanted share the position after the last.
  Buffer<uint32_t> slots;
};

// Number of splats that touch each tile. A range of tiles is added as four corner values, without a
// loop over its tiles. Cumulative sums of the corner values over columns and rows give the counts.
class TileCounts {
 public:
  static int64_t room(const TileGrid& grid) { return int64_t{grid.columns + 1} * (grid.rows + 1); }

  // Create counts of zero in `counts`, which holds room(grid) values.
  TileCounts(const TileGrid& grid, uint32_t* counts)
      : grid_(grid), stride_(grid.columns + 1), counts_(counts) {
    std::fill_n(counts_, room(grid), 0u);
  }

  [[gnu::always_inline]] inline void add(const TileRange& range) {
    uint32_t *top = counts_ + range.y0 * stride_, *below = counts_ + (range.y1 + 1) * stride_;
    ++top[range.x0];
    --top[range.x1 + 1];
    --below[range.x0];
    ++below[range.x1 + 1];
  }

  // Replace the corner values by the counts of the wanted tiles, row by row, and zeros for the
  // others.
  void finish() {
    uint32_t* out = counts_;  // Writing never overtakes reading.
    for (int row = 0; row < grid_.rows; ++row) {
      uint32_t sum = 0;
      for (int column = 0; column < grid_.columns; ++column, ++out) {
        sum += counts_[row * stride_ + column];
        *out = sum + (row > 0 ? out[-grid_.columns] : 0);
      }
    }
    for (int64_t tile = 0; tile < grid_.count(); ++tile)
      if (!grid_.wants(tile)) counts_[tile] = 0;
  }

 private:
  const TileGrid& grid_;
  const int64_t stride_;
  uint32_t* counts_;
};

// Call f(position of the pair among those of the splat, tile) for the tiles of a range, row by row.
template <class F>
[[gnu::always_inline]] inline void each_pair(const TileRange& range, int columns, const F& f) {
  uint32_t x = range.x0, tile = range.y0 * columns + range.x0;
  const uint32_t to_next_row = columns - (range.x1 - range.x0);
  const uint32_t pairs = area(range);
  for (uint32_t pair = 0; pair < pairs; ++pair) {  // A single loop has fewer mispredicted branches.
    f(pair, tile);
    const bool at_end = x == range.x1;
    x = at_end ? range.x0 : x + 1;
    tile += at_end ? to_next_row : 1;
  }
}

// Call f(splat, its range) for positions [begin, end) of the splats in the order of their depths.
template <class F>
[[gnu::always_inline]] inline void each_by_depth(const VisibleSplats& visible, int64_t begin,
                                                 int64_t end, const F& f) {
  for (int64_t i = begin; i < end; ++i) {
    __builtin_prefetch(&visible.tiles[visible.depths[std::min(i + kPrefetchAhead, end - 1)].value]);
    const uint32_t splat = visible.depths[i].value;
    f(splat, visible.tiles[splat]);
  }
}

// Sort the splats, which are in depth order, by tile (counting sort).
inline void list_by_tile(const VisibleSplats& visible, const TileGrid& grid, Team& team,
                         TileLists& out) {
  out.columns = grid.columns;
  out.rows = grid.rows;
  const int64_t tiles = grid.count(), room = TileCounts::room(grid);
  const Pieces pieces(visible.count, team);
  Buffer<uint32_t> places(pieces.count() * room);
  team.each(pieces.count(), [&](int64_t piece) {
    TileCounts counts(grid, &places[piece * room]);
    each_by_depth(visible, pieces.begin(piece), pieces.end(piece),
                  [&](uint32_t, const TileRange& range) { counts.add(range); });
    counts.finish();
  });
  const uint32_t total = to_offsets(places.data(), pieces.count(), tiles, room);
  out.start.resize(tiles + 1);
  std::fill(out.start.data(), out.start.data() + tiles + 1, total);
  if (total > 0) std::copy(places.data(), places.data() + tiles, out.start.data());
  out.slots.resize(visible.pairs + 1);
  out.splats.resize(total + kPrefetchAhead);
  std::fill(out.splats.data() + total, out.splats.data() + total + kPrefetchAhead, 0u);
  team.each(pieces.count(), [&](int64_t piece) {
    uint32_t* place = &places[piece * room];
    each_by_depth(visible, pieces.begin(piece), pieces.end(piece),
                  [&](uint32_t splat, const TileRange& range) {
                    uint32_t* slots = &out.slots[visible.first_pair(splat)];
                    each_pair(range, out.columns, [&](uint32_t pair, uint32_t tile) {
                      slots[pair] = total;
                      if (!grid.wants(tile)) return;
                      slots[pair] = place[tile]++;
                      out.splats[slots[pair]] = splat;
                    });
                  });
  });
}

}  // namespace ldo::LDO_ISA
