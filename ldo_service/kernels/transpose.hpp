// Transpose of a 16x16 matrix of floats, in registers.
#pragma once
#include <utility>

#include "simd.hpp"

namespace ldo::LDO_ISA {

// Return the lanes of two registers, of kPerRegister each, in a new order.
template <class Pattern, int... Lane>
FloatRegister shuffle(FloatRegister a, FloatRegister b, std::integer_sequence<int, Lane...>) {
  return __builtin_shufflevector(a, b, Pattern::source(Lane)...);
}
template <class Pattern>
FloatRegister shuffle(FloatRegister a, FloatRegister b) {
  return shuffle<Pattern>(a, b, std::make_integer_sequence<int, kPerRegister>());
}

// Pattern that alternates pieces of `Width` lanes of a and b in each group of four lanes. Pieces
// come from the low or the high half of each group.
template <int Width, bool High>
struct Interleave {
  static constexpr int source(int lane) {
    const int group = lane & ~3, place = lane & 3;
    const int piece = place / Width, within = place % Width;
    return group + (High ? 2 : 0) + piece / 2 * Width + within + (piece % 2 ? kPerRegister : 0);
  }
};

// Pattern that swaps the off-diagonal pieces of the 2x2 matrix whose rows are a and b, each with
// pieces of `Width` lanes.
template <int Width, bool Second>
struct Swap {
  static constexpr int source(int lane) {
    const bool from_b = lane & Width;
    return (lane & ~Width) + (Second ? Width : 0) + (from_b ? kPerRegister : 0);
  }
};

// Swap the two off-diagonal blocks of Width x Width in each block of twice this size.
template <int Width>
void transpose_blocks(Floats (&rows)[kLanes]) {
  for (int i = 0; i < kLanes; ++i) {
    if (i & Width) continue;
    Floats &a = rows[i], &b = rows[i + Width];
    if constexpr (Width < kPerRegister) {
      each_register([&](int k) {
        const FloatRegister first = shuffle<Swap<Width, false>>(a.v[k], b.v[k]);
        b.v[k] = shuffle<Swap<Width, true>>(a.v[k], b.v[k]);
        a.v[k] = first;
      });
    } else {  // Whole registers change places.
      constexpr int step = Width / kPerRegister;
      for (int k = 0; k < kRegisters; ++k)
        if (!(k & step)) std::swap(a.v[k + step], b.v[k]);
    }
  }
}

// Swap rows[i] lane j with rows[j] lane i.
inline void transpose(Floats (&rows)[kLanes]) {
  for (int i = 0; i < kLanes; i += 4)  // Blocks of 4x4.
    each_register([&](int k) {
      FloatRegister &a = rows[i].v[k], &b = rows[i + 1].v[k], &c = rows[i + 2].v[k],
                    &d = rows[i + 3].v[k];
      const FloatRegister ab0 = shuffle<Interleave<1, false>>(a, b),
                          ab1 = shuffle<Interleave<1, true>>(a, b),
                          cd0 = shuffle<Interleave<1, false>>(c, d),
                          cd1 = shuffle<Interleave<1, true>>(c, d);
      a = shuffle<Interleave<2, false>>(ab0, cd0);
      b = shuffle<Interleave<2, true>>(ab0, cd0);
      c = shuffle<Interleave<2, false>>(ab1, cd1);
      d = shuffle<Interleave<2, true>>(ab1, cd1);
    });
  transpose_blocks<4>(rows);
  transpose_blocks<8>(rows);
}

// Sixteen floats in memory, for rows of `Floats` with indices known only at run time. GCC would
// copy the structs through general registers.
using FloatsRow = float[kLanes];

// Transpose `count` rows in memory; missing rows are zero.
inline void transpose(const FloatsRow* rows, int count, Floats (&columns)[kLanes]) {
  for (int i = 0; i < kLanes; ++i) columns[i] = i < count ? Floats::load(rows[i]) : Floats(0.0f);
  transpose(columns);
}

}  // namespace ldo::LDO_ISA
