// Which splats each tile of 16x16 pixels blends, in which order.
#pragma once
#include "projection.hpp"
#include "radix_sort.hpp"

namespace ldo::LDO_ISA {

struct VisibleSplats {
  explicit VisibleSplats(size_t capacity) : splats(capacity), tiles(capacity), depths(capacity) {}
  Buffer<Splat> splats;  // those of piece p start at p * kProjectionPiece
  Buffer<TileRange> tiles;
  Buffer<Keyed> depths;  // by (z, index of the Gaussian): key = bits of z, value = place in splats
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
      out.splats[place++] = {s.u[k],
                             s.v[k],
                             s.a[k],
                             s.b[k],
                             s.c[k],
                             s.log2_opacity[k],
                             s.x_slope[k],
                             s.y_slope[k],
                             {columns[kColor][k], columns[kColor + 1][k], columns[kColor + 2][k]},
                             s.z[k]};
    }
  }
  return place - begin;
}

// Depths are positive, so their bits order as they do. Ties fall to the lower index, because
// splats are in the order of the Gaussians and the sort is stable.
inline void order_by_depth(VisibleSplats& visible, const Buffer<int64_t>& counts, int threads) {
  Buffer<int64_t> offsets(counts.size());
  int64_t total = 0;
  for (size_t piece = 0; piece < counts.size(); ++piece) {
    offsets[piece] = total;
    total += counts[piece];
  }
  visible.count = total;
  uint32_t lowest = ~0u, highest = 0;
  Buffer<Keyed> items(total);
  parallel_for(counts.size(), threads, [&](int64_t piece) {
    for (int64_t k = 0; k < counts[piece]; ++k) {
      const uint32_t place = static_cast<uint32_t>(piece * kProjectionPiece + k);
      uint32_t key;
      std::memcpy(&key, &visible.splats[place].z, sizeof key);
      items[offsets[piece] + k] = {key, place};
    }
  });
  for (int64_t i = 0; i < total; ++i) {
    lowest = std::min(lowest, items[i].key);
    highest = std::max(highest, items[i].key);
  }
  for (int64_t i = 0; i < total; ++i) items[i].key -= lowest;
  const Keyed* sorted =
      radix_sort(items.data(), visible.depths.data(), total, highest - lowest, threads);
  if (sorted != visible.depths.data()) std::copy(sorted, sorted + total, visible.depths.data());
}

inline VisibleSplats project(const float* rows, int64_t n, const View& view, int threads) {
  VisibleSplats visible(n);
  const Projection projection(view);
  Buffer<int64_t> counts((n + kProjectionPiece - 1) / kProjectionPiece);
  parallel_for(counts.size(), threads, [&](int64_t piece) {
    const int64_t begin = piece * kProjectionPiece;
    counts[piece] =
        project_piece(rows, begin, std::min(n, begin + kProjectionPiece), projection, visible);
  });
  order_by_depth(visible, counts, threads);
  return visible;
}

constexpr int kPrefetchAhead = 24;  // splats, while those of a tile are read in list order

struct TileLists {
  int columns, rows;
  Buffer<uint32_t> start;   // [columns * rows + 1] into splats
  Buffer<uint32_t> splats;  // front to back within a tile; kPrefetchAhead zeros at the end
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

// Writes the pairs of one piece and counts them per tile.
inline void write_pairs(const VisibleSplats& visible, int64_t begin, int64_t end, int columns,
                        Keyed* pair, uint32_t* counts) {
  for (int64_t i = begin; i < end; ++i) {
    const uint32_t splat = visible.depths[i].value;
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
inline TileLists list_by_tile(const VisibleSplats& visible, const View& view, int threads) {
  const int columns = (view.width + kTile - 1) / kTile, rows = (view.height + kTile - 1) / kTile;
  const int64_t tiles = static_cast<int64_t>(columns) * rows;
  const Pieces pieces(visible.count);
  const Buffer<int64_t> start = count_pairs(visible, pieces, threads);
  const int64_t total = start[pieces.count()];
  Buffer<Keyed> pairs(total);
  Buffer<uint32_t> places(pieces.count() * tiles);
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* counts = &places[piece * tiles];
    std::fill(counts, counts + tiles, 0u);
    write_pairs(visible, pieces.begin(piece), pieces.end(piece), columns, &pairs[start[piece]],
                counts);
  });
  to_offsets(places.data(), pieces.count(), tiles);
  TileLists lists{columns, rows, Buffer<uint32_t>(tiles + 1),
                  Buffer<uint32_t>(total + kPrefetchAhead)};
  std::fill(lists.splats.data() + total, lists.splats.data() + total + kPrefetchAhead, 0u);
  std::fill(lists.start.data(), lists.start.data() + tiles + 1, static_cast<uint32_t>(total));
  if (total > 0) std::copy(places.data(), places.data() + tiles, lists.start.data());
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* place = &places[piece * tiles];
    for (int64_t i = start[piece]; i < start[piece + 1]; ++i)
      lists.splats[place[pairs[i].key]++] = pairs[i].value;
  });
  return lists;
}

}  // namespace ldo::LDO_ISA
