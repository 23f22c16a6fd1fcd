// Which splats each tile of 16x16 pixels blends, in which order.
#pragma once
#include "projection.hpp"
#include "radix_sort.hpp"

namespace ldo::LDO_ISA {

constexpr int64_t kProjectionPiece = 4096;  // Gaussians

struct PieceCounts {  // of the splats of a piece, and their pairs with tiles
  int64_t splats;
  uint32_t pairs;
  int64_t first_splat = 0, first_pair = 0;  // among all
};

struct VisibleSplats {
  Buffer<Splat> splats;  // those of piece p start at p * kProjectionPiece
  Buffer<TileRange> tiles;
  Buffer<uint32_t> gaussians;  // row of each splat
  Buffer<PieceCounts> counts;  // of each piece
  Buffer<Keyed> depths;  // by (z, index of the Gaussian): key = bits of z, value = place in splats
  Buffer<Keyed> spare;   // for sorting
  int64_t count = 0;
  int64_t pairs = 0;  // of a splat and a tile of its range

  int64_t first_pair(uint32_t splat) const {
    return counts[splat / kProjectionPiece].first_pair + tiles[splat].first_pair;
  }
};

// Projects rows [begin, end) and appends the visible ones at `begin`.
inline PieceCounts project_piece(const float* rows, int64_t begin, int64_t end,
                                 const Projection& project, VisibleSplats& out) {
  alignas(64) float columns[kRowFloats][kLanes];
  alignas(64) SplatColumns s;
  int64_t place = begin;
  uint32_t pairs = 0;
  for (int64_t i = begin; i < end; i += kLanes) {
    transpose_rows(rows + i * kRowFloats, static_cast<int>(std::min<int64_t>(kLanes, end - i)),
                   columns);
    project(columns, s);
    for (uint32_t rest = s.drawn; rest != 0; rest &= rest - 1) {
      const int k = __builtin_ctz(rest);
      TileRange& tiles = out.tiles[place];
      if (!tiles_of(s, k, project.view, tiles)) continue;
      tiles.first_pair = pairs;
      pairs += area(tiles);
      out.splats[place] = {s.u[k],
                           s.v[k],
                           s.a[k],
                           s.b[k],
                           s.c[k],
                           s.log2_opacity[k],
                           s.x_slope[k],
                           s.y_slope[k],
                           {columns[kColor][k], columns[kColor + 1][k], columns[kColor + 2][k]},
                           s.z[k]};
      out.gaussians[place++] = static_cast<uint32_t>(i + k);
    }
  }
  return {place - begin, pairs};
}

// Says where the splats and the pairs of each piece begin among all.
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

// Depths are positive, so their bits order as they do. Ties fall to the lower index, because
// splats are in the order of the Gaussians and the sort is stable.
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

inline void project(const float* rows, int64_t n, const View& view, Team& team,
                    VisibleSplats& out) {
  out.splats.resize(n);
  out.tiles.resize(n);
  out.gaussians.resize(n);
  out.counts.resize((n + kProjectionPiece - 1) / kProjectionPiece);
  const Projection projection(view);
  team.each(out.counts.size(), [&](int64_t piece) {
    const int64_t begin = piece * kProjectionPiece;
    out.counts[piece] =
        project_piece(rows, begin, std::min(n, begin + kProjectionPiece), projection, out);
  });
  sum_counts(out);
  order_by_depth(out, team);
}

constexpr int kPrefetchAhead = 24;  // splats, while those of a tile are read in list order

struct TileLists {
  int columns = 0, rows = 0;
  Buffer<uint32_t> start;   // [columns * rows + 1] into splats
  Buffer<uint32_t> splats;  // front to back within a tile; kPrefetchAhead zeros at the end
  // Where in `splats` each pair of a splat and a tile went: splats as in VisibleSplats, and the
  // tiles of their ranges row by row.
  Buffer<uint32_t> slots;
};

// f(place of the pair among those of the splat, tile) for the tiles of a range, row by row.
template <class F>
[[gnu::always_inline]] inline void each_pair(const TileRange& range, int columns, const F& f) {
  uint32_t x = range.x0, tile = range.y0 * columns + range.x0;
  const uint32_t to_next_row = columns - (range.x1 - range.x0);
  const uint32_t pairs = area(range);
  for (uint32_t pair = 0; pair < pairs; ++pair) {  // one loop: fewer mispredicted branches
    f(pair, tile);
    const bool at_end = x == range.x1;
    x = at_end ? range.x0 : x + 1;
    tile += at_end ? to_next_row : 1;
  }
}

// f(splat, its range) for places [begin, end) of the splats in the order of their depths.
template <class F>
[[gnu::always_inline]] inline void each_by_depth(const VisibleSplats& visible, int64_t begin,
                                                 int64_t end, const F& f) {
  for (int64_t i = begin; i < end; ++i) {
    __builtin_prefetch(&visible.tiles[visible.depths[std::min(i + kPrefetchAhead, end - 1)].value]);
    const uint32_t splat = visible.depths[i].value;
    f(splat, visible.tiles[splat]);
  }
}

// A counting sort by tile of the splats in depth order.
inline void list_by_tile(const VisibleSplats& visible, const View& view, Team& team,
                         TileLists& out) {
  out.columns = (view.width + kTile - 1) / kTile;
  out.rows = (view.height + kTile - 1) / kTile;
  const int64_t tiles = static_cast<int64_t>(out.columns) * out.rows;
  const Pieces pieces(visible.count, team);
  Buffer<uint32_t> places(pieces.count() * tiles);
  team.each(pieces.count(), [&](int64_t piece) {
    uint32_t* counts = &places[piece * tiles];
    std::fill(counts, counts + tiles, 0u);
    each_by_depth(visible, pieces.begin(piece), pieces.end(piece),
                  [&](uint32_t, const TileRange& range) {
                    each_pair(range, out.columns, [&](uint32_t, uint32_t tile) { ++counts[tile]; });
                  });
  });
  const uint32_t total = to_offsets(places.data(), pieces.count(), tiles);
  out.start.resize(tiles + 1);
  std::fill(out.start.data(), out.start.data() + tiles + 1, total);
  if (total > 0) std::copy(places.data(), places.data() + tiles, out.start.data());
  out.slots.resize(total + 1);
  out.splats.resize(total + kPrefetchAhead);
  std::fill(out.splats.data() + total, out.splats.data() + total + kPrefetchAhead, 0u);
  team.each(pieces.count(), [&](int64_t piece) {
    uint32_t* place = &places[piece * tiles];
    each_by_depth(visible, pieces.begin(piece), pieces.end(piece),
                  [&](uint32_t splat, const TileRange& range) {
                    uint32_t* slots = &out.slots[visible.first_pair(splat)];
                    each_pair(range, out.columns, [&](uint32_t pair, uint32_t tile) {
                      const uint32_t slot = place[tile]++;
                      out.splats[slot] = splat;
                      slots[pair] = slot;
                    });
                  });
  });
}

}  // namespace ldo::LDO_ISA
