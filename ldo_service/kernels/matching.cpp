// Nearest binary descriptors, compiled once per instruction set (LDO_ISA).
#include "matching.hpp"

#include <cstring>

namespace ldo::LDO_ISA {
namespace {

struct Descriptor {
  uint64_t words[kDescriptorBytes / 8];
};

Descriptor load(const uint8_t* bytes) {
  Descriptor result;
  std::memcpy(result.words, bytes, kDescriptorBytes);
  return result;
}

// Return the number of set bits. A processor without an instruction for it adds up groups of bits.
int32_t set_bits(uint64_t x) {
#if defined(__x86_64__) && !defined(__POPCNT__)
  x -= x >> 1 & 0x5555555555555555;
  x = (x & 0x3333333333333333) + (x >> 2 & 0x3333333333333333);
  return static_cast<int32_t>(((x + (x >> 4)) & 0x0f0f0f0f0f0f0f0f) * 0x0101010101010101 >> 56);
#else
  return __builtin_popcountll(x);
#endif
}

int32_t distance(const Descriptor& a, const Descriptor& b) {
  int32_t bits = 0;
  for (int k = 0; k < kDescriptorBytes / 8; ++k) bits += set_bits(a.words[k] ^ b.words[k]);
  return bits;
}

}  // namespace

void nearest(const uint8_t* descriptors, int64_t n, const uint8_t* candidates, int64_t count,
             Nearest& result) {
  constexpr int32_t kFarthest = 8 * kDescriptorBytes + 1;
  for (int64_t i = 0; i < n; ++i) {
    const Descriptor wanted = load(descriptors + kDescriptorBytes * i);
    int64_t index = 0;
    int32_t least = kFarthest, second = kFarthest;
    for (int64_t j = 0; j < count; ++j) {
      const int32_t bits = distance(wanted, load(candidates + kDescriptorBytes * j));
      if (bits >= second) continue;
      if (bits < least) {
        second = least;
        least = bits;
        index = j;
      } else {
        second = bits;
      }
    }
    result.index[i] = index;
    result.nearest[i] = least;
    result.second[i] = second;
  }
}

}  // namespace ldo::LDO_ISA
