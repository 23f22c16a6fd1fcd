// Which splats each tile of 16x16 pixels blends, in which order.
#pragma once
#include "projection.hpp"
#include "radix_sort.hpp"

namespace ldo::LDO_ISA {

struct VisibleSplats {
  Buffer<Splat> splats;  // those of piece p start at p * kProjectionPiece
  Buffer<TileRange> tiles;
  Buffer<uint32_t> gaussians;  // row of each splat
  Buffer<int64_t> counts;      // splats of each piece
  Buffer<Keyed> depths;  // by (z, index of the Gaussian): key = bits of z, value = place in splats
  Buffer<Keyed> spare;   // for sorting
  int64_t count = 0;
};

constexpr int64_t kProjectionPiece = 4096;  // Gaussians

// Projects rows [begin, end) and appends the visible ones at `begin`; returns how many.
inline int64_t project_piece(const float* rows, int64_t begin, int64_t end,
                             const Projection& project, VisibleSplats& out) {
  alignas(64) float columns[kRowFloats][kLanes];
  alignas(64) SplatColumns s;
  int64_t place = begin;
  for (int64_t i = begin; i < end; i += kLanes) {
    transpose_rows(rows + i * kRowFloats, static_cast<int>(std::min<int64_t>(kLanes, end - i)),
                   columns);
    project(columns, s);
    for (uint32_t rest = s.drawn; rest != 0; rest &= rest - 1) {
      const int k = __builtin_ctz(rest);
      if (!tiles_of(s, k, project.view, out.tiles[place])) continue;
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
  return place - begin;
}

// Depths are positive, so their bits order as they do. Ties fall to the lower index, because
// splats are in the order of the Gaussians and the sort is stable.
inline void order_by_depth(VisibleSplats& visible, int threads) {
  const size_t pieces = visible.counts.size();
  Buffer<int64_t> offsets(pieces);
  Buffer<uint32_t> lowest(pieces), highest(pieces);
  int64_t total = 0;
  for (size_t piece = 0; piece < pieces; ++piece) {
    offsets[piece] = total;
    total += visible.counts[piece];
  }
  visible.count = total;
  visible.depths.resize(total);
  visible.spare.resize(total);
  Keyed* items = visible.depths.data();
  parallel_for(pieces, threads, [&](int64_t piece) {
    uint32_t low = ~0u, high = 0;
    for (int64_t k = 0; k < visible.counts[piece]; ++k) {
      const uint32_t place = static_cast<uint32_t>(piece * kProjectionPiece + k);
      uint32_t key;
      std::memcpy(&key, &visible.splats[place].z, sizeof key);
      low = std::min(low, key);
      high = std::max(high, key);
      items[offsets[piece] + k] = {key, place};
    }
    lowest[piece] = low;
    highest[piece] = high;
  });
  if (total == 0) return;
  const uint32_t low = *std::min_element(lowest.data(), lowest.data() + pieces),
                 high = *std::max_element(highest.data(), highest.data() + pieces);
  if (radix_sort(items, visible.spare.data(), total, low, high, threads) != items)
    std::swap(visible.depths, visible.spare);
}

inline void project(const float* rows, int64_t n, const View& view, int threads,
                    VisibleSplats& out) {
  out.splats.resize(n);
  out.tiles.resize(n);
  out.gaussians.resize(n);
  out.counts.resize((n + kProjectionPiece - 1) / kProjectionPiece);
  const Projection projection(view);
  parallel_for(out.counts.size(), threads, [&](int64_t piece) {
    const int64_t begin = piece * kProjectionPiece;
    out.counts[piece] =
        project_piece(rows, begin, std::min(n, begin + kProjectionPiece), projection, out);
  });
  order_by_depth(out, threads);
}

constexpr int kPrefetchAhead = 24;  // splats, while those of a tile are read in list order

struct TileLists {
  int columns = 0, rows = 0;
  Buffer<uint32_t> start;   // [columns * rows + 1] into splats
  Buffer<uint32_t> splats;  // front to back within a tile; kPrefetchAhead zeros at the end
  // Splat i is at the places slots[first[i]], slots[first[i] + 1], ... of `splats`, one a tile.
  Buffer<uint32_t> first, slots;
  Buffer<Keyed> pairs;  // scratch
};

inline int64_t area(const TileRange& r) { return (r.x1 - r.x0 + 1) * (r.y1 - r.y0 + 1); }

// Where the (tile, splat) pairs of each piece start, and their number at the end.
inline Buffer<int64_t> count_pairs(const VisibleSplats& visible, const Pieces& pieces,
                                   int threads) {
  Buffer<int64_t> start(pieces.count() + 1);
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    int64_t sum = 0;
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i)
      sum += area(visible.tiles[visible.depths[i].value]);
    start[piece + 1] = sum;
  });
  start[0] = 0;
  for (int64_t piece = 0; piece < pieces.count(); ++piece) start[piece + 1] += start[piece];
  return start;
}

// Writes the pairs [from, ...) of one piece and counts them per tile.
inline void write_pairs(const VisibleSplats& visible, int64_t begin, int64_t end, int64_t from,
                        TileLists& out, uint32_t* counts) {
  const int columns = out.columns;
  Keyed* pair = &out.pairs[from];
  for (int64_t i = begin; i < end; ++i) {
    __builtin_prefetch(&visible.tiles[visible.depths[std::min(i + kPrefetchAhead, end - 1)].value]);
    const uint32_t splat = visible.depths[i].value;
    out.first[splat] = static_cast<uint32_t>(pair - out.pairs.data());
    const TileRange& range = visible.tiles[splat];
    uint32_t x = range.x0, tile = range.y0 * columns + range.x0;
    const uint32_t to_next_row = columns - (range.x1 - range.x0);
    for (int64_t left = area(range); left > 0; --left) {  // one loop: fewer mispredicted branches
      ++counts[tile];
      *pair++ = {tile, splat};
      const bool at_end = x == range.x1;
      x = at_end ? range.x0 : x + 1;
      tile += at_end ? to_next_row : 1;
    }
  }
}

// A counting sort by tile of the splats in depth order, piece by piece.
inline void list_by_tile(const VisibleSplats& visible, const View& view, int threads,
                         TileLists& out) {
  out.columns = (view.width + kTile - 1) / kTile;
  out.rows = (view.height + kTile - 1) / kTile;
  const int64_t tiles = static_cast<int64_t>(out.columns) * out.rows;
  const Pieces pieces(visible.count);
  const Buffer<int64_t> start = count_pairs(visible, pieces, threads);
  const int64_t total = start[pieces.count()];
  out.first.resize(visible.splats.size());
  out.pairs.resize(total + 1);
  out.slots.resize(total + 1);
  Buffer<uint32_t> places(pieces.count() * tiles);
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* counts = &places[piece * tiles];
    std::fill(counts, counts + tiles, 0u);
    write_pairs(visible, pieces.begin(piece), pieces.end(piece), start[piece], out, counts);
  });
  to_offsets(places.data(), pieces.count(), tiles);
  out.start.resize(tiles + 1);
  out.splats.resize(total + kPrefetchAhead);
  std::fill(out.splats.data() + total, out.splats.data() + total + kPrefetchAhead, 0u);
  std::fill(out.start.data(), out.start.data() + tiles + 1, static_cast<uint32_t>(total));
  if (total > 0) std::copy(places.data(), places.data() + tiles, out.start.data());
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* place = &places[piece * tiles];
    for (int64_t i = start[piece]; i < start[piece + 1]; ++i) {
      const uint32_t slot = place[out.pairs[i].key]++;
      out.splats[slot] = out.pairs[i].value;
      out.slots[i] = slot;
    }
  });
}

}  // namespace ldo::LDO_ISA
