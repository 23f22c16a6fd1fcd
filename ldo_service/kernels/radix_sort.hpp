// Stable parallel radix sort, least significant digit first.
#pragma once
#include "buffer.hpp"
#include "parallel.hpp"

namespace ldo::LDO_ISA {

struct Keyed {
  uint32_t key, value;
};

constexpr int kDigitBits = 11;
constexpr int kDigits = 1 << kDigitBits;

// The pieces in which an array of n is worked on: few enough that their histograms stay in cache.
struct Pieces {
  explicit Pieces(int64_t n) : n(n), length(std::max<int64_t>(8192, (n + 15) / 16)) {}
  int64_t count() const { return (n + length - 1) / length; }
  int64_t begin(int64_t piece) const { return piece * length; }
  int64_t end(int64_t piece) const { return std::min(n, (piece + 1) * length); }
  int64_t n, length;
};

// Turns counts [pieces][bins] into the places where each piece starts writing each bin: bins in
// order, and within a bin the pieces in order. Returns the total.
inline uint32_t to_offsets(uint32_t* counts, int64_t pieces, int64_t bins) {
  uint32_t sum = 0;
  for (int64_t bin = 0; bin < bins; ++bin)
    for (int64_t piece = 0; piece < pieces; ++piece) {
      uint32_t& place = counts[piece * bins + bin];
      const uint32_t count = place;
      place = sum;
      sum += count;
    }
  return sum;
}

inline void sort_digit(const Keyed* from, Keyed* to, const Pieces& pieces, uint32_t lowest,
                       int shift, int threads, Buffer<uint32_t>& places) {
  const auto digit = [=](const Keyed& k) { return (k.key - lowest) >> shift & (kDigits - 1); };
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* counts = &places[piece * kDigits];
    std::fill(counts, counts + kDigits, 0u);
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i) ++counts[digit(from[i])];
  });
  to_offsets(places.data(), pieces.count(), kDigits);
  parallel_for(pieces.count(), threads, [&](int64_t piece) {
    uint32_t* place = &places[piece * kDigits];
    for (int64_t i = pieces.begin(piece); i < pieces.end(piece); ++i)
      to[place[digit(from[i])]++] = from[i];
  });
}

// Sorts items[0, n) by key, all in [lowest, highest]; equal keys keep their order. `spare` is as
// large and is overwritten. Returns the one of the two that holds the result.
inline Keyed* radix_sort(Keyed* items, Keyed* spare, int64_t n, uint32_t lowest, uint32_t highest,
                         int threads) {
  const Pieces pieces(n);
  Buffer<uint32_t> places(pieces.count() * kDigits);
  for (int shift = 0; shift < 32 && (highest - lowest) >> shift != 0; shift += kDigitBits) {
    sort_digit(items, spare, pieces, lowest, shift, threads, places);
    std::swap(items, spare);
  }
  return items;
}

}  // namespace ldo::LDO_ISA
