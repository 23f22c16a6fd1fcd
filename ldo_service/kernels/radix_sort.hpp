// Stable parallel radix sort, least significant digit first.
#pragma once
#include "buffer.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {

struct Keyed {
  uint32_t key, value;
};

// Limit at which the histogram and the cache lines that all bins write to fit in the cache.
constexpr int kMaxDigitBits = 12;

// Pieces in which an array of n items is sorted: one piece for a single thread, else four pieces
// per thread, because a thread may be delayed. The number of threads may decide the division,
// because a stable sort has only one possible result.
struct Pieces {
  Pieces(int64_t n, const Team& team) : n(n) {
    const int64_t wanted = team.size() == 1 ? 1 : int64_t{4} * team.size();
    length = std::max<int64_t>(4096, (n + wanted - 1) / wanted);
  }
  int64_t count() const { return (n + length - 1) / length; }
  int64_t begin(int64_t piece) const { return piece * length; }
  int64_t end(int64_t piece) const { return std::min(n, (piece + 1) * length); }
  int64_t n, length;
};

// Replace the counts of each piece and bin by the position where the piece starts to write the bin.
// The counts of successive pieces lie `stride` apart. The output is ordered by bin, and within a
// bin by piece. Return the sum of all counts.
inline uint32_t to_offsets(uint32_t* counts, int64_t pieces, int64_t bins, int64_t stride) {
  uint32_t sum = 0;
  for (int64_t bin = 0; bin < bins; ++bin)
    for (int64_t piece = 0; piece < pieces; ++piece) {
      uint32_t& place = counts[piece * stride + bin];
      const uint32_t count = place;
      place = sum;
      sum += count;
    }
  return sum;
}

struct Digit {
  uint32_t operator()(uint32_t key) const { return (key - lowest) >> shift & (bins() - 1); }
  uint32_t bins() const { return uint32_t{1} << bits; }
  uint32_t lowest;
  int shift, bits;
};

inline void sort_by(Digit digit, const Keyed* from, Keyed* to, const Pieces& pieces, Team& team,
                    Buffer<uint32_t>& places) {
  const auto bins_of = [&](int64_t piece) { return &places[piece * digit.bins()]; };
  team.each(pieces.count(), [&](int64_t piece) {
    uint32_t* counts = bins_of(piece);
    std::fill(counts, counts + digit.bins(), 0u);
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i) ++counts[digit(from[i].key)];
  });
  to_offsets(places.data(), pieces.count(), digit.bins(), digit.bins());
  team.each(pieces.count(), [&](int64_t piece) {
    uint32_t* place = bins_of(piece);
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i)
      to[place[digit(from[i].key)]++] = from[i];
  });
}

// Sort items[0, n) by key, all in [lowest, highest]; equal keys keep their order. `spare` has the
// same size and is overwritten. Return the array that holds the result: `items` or `spare`.
inline Keyed* radix_sort(Keyed* items, Keyed* spare, int64_t n, uint32_t lowest, uint32_t highest,
                         Team& team) {
  const int bits = highest == lowest ? 0 : 32 - __builtin_clz(highest - lowest);
  if (bits == 0) return items;
  const int digits = (bits + kMaxDigitBits - 1) / kMaxDigitBits;
  const int digit_bits = (bits + digits - 1) / digits;
  const Pieces pieces(n, team);
  Buffer<uint32_t> places(pieces.count() << digit_bits);
  for (int shift = 0; shift < bits; shift += digit_bits) {
    sort_by({lowest, shift, digit_bits}, items, spare, pieces, team, places);
    std::swap(items, spare);
  }
  return items;
}

}  // namespace ldo::LDO_ISA
