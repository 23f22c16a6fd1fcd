// Vectors of sixteen float lanes: one 4x4 block of pixels, or sixteen Gaussians.
//
// The code uses the vector extensions of GCC and Clang. A value is an array of native registers:
// 1 of 64, 2 of 32 or 4 of 16 bytes. A single 64-byte vector would be slow on a machine with
// narrower registers, because compilers turn its compares and selects into scalar code. All code is
// in a namespace named after the instruction set. The linker therefore never merges inline
// functions that were compiled for different instruction sets.
#pragma once
#include <cstdint>
#include <cstring>
#if defined(__SSE2__)
#include <immintrin.h>
#endif

namespace ldo::LDO_ISA {

constexpr int kLanes = 16;
#if defined(__AVX512F__)
constexpr int kRegisterBytes = 64;
#elif defined(__AVX2__)
constexpr int kRegisterBytes = 32;
#else
constexpr int kRegisterBytes = 16;
#endif
constexpr int kRegisters = kLanes * 4 / kRegisterBytes;
constexpr int kPerRegister = kLanes / kRegisters;  // Lanes.

typedef float FloatRegister __attribute__((vector_size(kRegisterBytes)));
typedef int32_t IntRegister __attribute__((vector_size(kRegisterBytes)));
static_assert(sizeof(FloatRegister) == kRegisterBytes);

// Apply f to every register index. The loop is unrolled, so that the arrays stay in registers.
template <class F>
[[gnu::always_inline]] inline void each_register(F f) {
#pragma GCC unroll 4
  for (int k = 0; k < kRegisters; ++k) f(k);
}

struct Mask {  // Each lane has all bits set, or none.
  IntRegister v[kRegisters];
};

struct Floats {
  FloatRegister v[kRegisters];

  Floats() = default;
  Floats(float x) {  // Implicit: a scalar becomes sixteen equal lanes.
    each_register([&](int k) { v[k] = x - FloatRegister{}; });  // x - 0 folds; 0 + x does not.
  }
  static Floats load(const float* p) {
    Floats out;  // Copy each register alone: GCC would copy 64 bytes at once through the stack.
    each_register([&](int k) { std::memcpy(&out.v[k], p + k * kPerRegister, kRegisterBytes); });
    return out;
  }
  void store(float* p) const {
    each_register([&](int k) { std::memcpy(p + k * kPerRegister, &v[k], kRegisterBytes); });
  }

  static Floats load_first(const float* p, int n) {  // The other lanes are zero.
    if (n == kLanes) return load(p);
    alignas(64) float lanes[kLanes] = {};
    std::memcpy(lanes, p, n * sizeof(float));
    return load(lanes);
  }
  void store_first(float* p, int n) const {
    if (n == kLanes) return store(p);
    alignas(64) float lanes[kLanes];
    store(lanes);
    std::memcpy(p, lanes, n * sizeof(float));
  }
  static Floats ramp() {  // 0, 1, 2, ...
    alignas(64) float lanes[kLanes];
    for (int i = 0; i < kLanes; ++i) lanes[i] = static_cast<float>(i);
    return load(lanes);
  }

  // Load four lanes from each of four rows that lie `stride` floats apart.
  static Floats load_rows(const float* p, int64_t stride) {
#if defined(__AVX512F__)
    const auto row = [&](int i) { return _mm_loadu_ps(p + i * stride); };
    const __m512 two = _mm512_insertf32x4(_mm512_castps128_ps512(row(0)), row(1), 1);
    return of(_mm512_insertf32x4(_mm512_insertf32x4(two, row(2), 2), row(3), 3));
#elif defined(__AVX2__)
    const auto row = [&](int i) { return _mm_loadu_ps(p + i * stride); };
    return of(_mm256_insertf128_ps(_mm256_castps128_ps256(row(0)), row(1), 1),
              _mm256_insertf128_ps(_mm256_castps128_ps256(row(2)), row(3), 1));
#else
    Floats out;
    for (int i = 0; i < 4; ++i) std::memcpy(&out.v[i], p + i * stride, sizeof out.v[i]);
    return out;
#endif
  }

 private:
  template <class... Registers>
  static Floats of(Registers... registers) {
    Floats out;
    int k = 0;
    ((out.v[k++] = registers), ...);
    return out;
  }
};

#define LDO_OPERATOR(Result, op)                                \
  inline Result operator op(Floats a, Floats b) {               \
    Result out;                                                 \
    each_register([&](int k) { out.v[k] = a.v[k] op b.v[k]; }); \
    return out;                                                 \
  }
LDO_OPERATOR(Floats, +)
LDO_OPERATOR(Floats, -)
LDO_OPERATOR(Floats, *)
LDO_OPERATOR(Floats, /)
LDO_OPERATOR(Mask, <)
LDO_OPERATOR(Mask, >=)
#undef LDO_OPERATOR

inline Mask operator&(Mask a, Mask b) {
  Mask out;
  each_register([&](int k) { out.v[k] = a.v[k] & b.v[k]; });
  return out;
}

inline Floats select(Mask m, Floats yes, Floats no) {
  Floats out;
  each_register([&](int k) { out.v[k] = m.v[k] ? yes.v[k] : no.v[k]; });
  return out;
}

// Return the lower value of each lane. Compilers turn `a < b ? a : b` into two instructions,
// although one instruction exists.
inline FloatRegister least(FloatRegister a, FloatRegister b) {
#if defined(__AVX512F__)
  return _mm512_min_ps(a, b);
#elif defined(__AVX2__)
  return _mm256_min_ps(a, b);
#elif defined(__SSE2__)
  return _mm_min_ps(a, b);
#else
  return a < b ? a : b;
#endif
}

inline FloatRegister greatest(FloatRegister a, FloatRegister b) {
#if defined(__AVX512F__)
  return _mm512_max_ps(a, b);
#elif defined(__AVX2__)
  return _mm256_max_ps(a, b);
#elif defined(__SSE2__)
  return _mm_max_ps(a, b);
#else
  return a > b ? a : b;
#endif
}

inline Floats min(Floats a, Floats b) {
  Floats out;
  each_register([&](int k) { out.v[k] = least(a.v[k], b.v[k]); });
  return out;
}

inline Floats max(Floats a, Floats b) {
  Floats out;
  each_register([&](int k) { out.v[k] = greatest(a.v[k], b.v[k]); });
  return out;
}

inline Floats clamp(Floats x, Floats low, Floats high) { return min(max(x, low), high); }

// Return the mask as bits: bit i is lane i.
inline uint32_t bits(Mask m) {
#if defined(__AVX512DQ__)
  return _mm512_movepi32_mask(reinterpret_cast<__m512i>(m.v[0]));
#elif defined(__AVX2__)
  const auto half = [&](int k) { return _mm256_movemask_ps(reinterpret_cast<__m256>(m.v[k])); };
  return static_cast<uint32_t>(half(0) | half(1) << 8);
#elif defined(__SSE2__)
  uint32_t out = 0;
  each_register([&](int k) {
    out |= static_cast<uint32_t>(_mm_movemask_ps(reinterpret_cast<__m128>(m.v[k]))) << 4 * k;
  });
  return out;
#else
  uint32_t out = 0;
  each_register([&](int k) {
    const IntRegister bit = m.v[k] & IntRegister{1, 2, 4, 8};
    out |= static_cast<uint32_t>(bit[0] | bit[1] | bit[2] | bit[3]) << 4 * k;
  });
  return out;
#endif
}

inline bool any(Mask m) { return bits(m) != 0; }

// Return 2^x for x in [-126, 126], relative error below 4e-7. Adding 1.5 * 2^23 leaves the nearest
// integer in the low bits. A minimax polynomial approximates the fraction in [-0.5, 0.5].
inline Floats exp2(Floats x) {
  Floats out;
  each_register([&](int k) {
    const FloatRegister shifted = x.v[k] + 12582912.0f;
    const FloatRegister f = x.v[k] - (shifted - 12582912.0f);
    FloatRegister p = f * 1.326472725e-03f + 9.671512688e-03f;
    p = p * f + 5.550733744e-02f;
    p = p * f + 2.402224208e-01f;
    p = p * f + 6.931469776e-01f;
    p = p * f + 1.0f;
    const IntRegister exponent = reinterpret_cast<IntRegister>(shifted) << 23;
    out.v[k] = reinterpret_cast<FloatRegister>(reinterpret_cast<IntRegister>(p) + exponent);
  });
  return out;
}

// Return log2 of normal x > 0, absolute error below 1e-6: the exponent plus the series of atanh.
inline Floats log2(Floats x) {
  Floats out;
  each_register([&](int k) {
    const IntRegister i = reinterpret_cast<IntRegister>(x.v[k]);
    const IntRegister e = (i - 0x3f3504f3) >> 23;  // Mantissa in [sqrt(1/2), sqrt(2)).
    const FloatRegister m = reinterpret_cast<FloatRegister>(i - (e << 23));
    const FloatRegister s = (m - 1.0f) / (m + 1.0f), s2 = s * s;
    FloatRegister p = s2 * 0.41219858f + 0.57707801f;
    p = p * s2 + 0.96179669f;
    p = p * s2 + 2.88539008f;
    out.v[k] = __builtin_convertvector(e, FloatRegister) + p * s;
  });
  return out;
}

inline FloatRegister square_root(FloatRegister x) {
#if defined(__AVX512F__)
  return _mm512_sqrt_ps(x);
#elif defined(__AVX2__)
  return _mm256_sqrt_ps(x);
#elif defined(__SSE2__)
  return _mm_sqrt_ps(x);
#else
  for (int i = 0; i < kPerRegister; ++i) x[i] = __builtin_sqrtf(x[i]);
  return x;
#endif
}

inline Floats sqrt(Floats x) {
  Floats out;
  each_register([&](int k) { out.v[k] = square_root(x.v[k]); });
  return out;
}

// Return the sum of the lanes, in an order that is the same on every machine. The upper half is
// repeatedly added to the lower half. Because only halves of registers are added, compilers cannot
// fuse an addition with the product that computed x.
inline float sum(Floats x) {
#if defined(__AVX512F__)
  const __m256 eight = _mm512_castps512_ps256(x.v[0]) + _mm512_extractf32x8_ps(x.v[0], 1);
  const __m128 four = _mm256_castps256_ps128(eight) + _mm256_extractf128_ps(eight, 1);
  return (four[0] + four[2]) + (four[1] + four[3]);
#else
  alignas(64) float lanes[kLanes];
  x.store(lanes);
  for (int half = kLanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; ++i) lanes[i] += lanes[i + half];
  return lanes[0];
#endif
}

inline float lowest(Floats x) {  // Minimum of the lanes.
#if defined(__AVX512F__)
  return _mm512_reduce_min_ps(x.v[0]);
#else
  alignas(64) float lanes[kLanes];
  x.store(lanes);
  for (int half = kLanes / 2; half > 0; half /= 2)
    for (int i = 0; i < half; ++i)
      lanes[i] = lanes[i + half] < lanes[i] ? lanes[i + half] : lanes[i];
  return lanes[0];
#endif
}
inline float highest(Floats x) { return -lowest(Floats(0.0f) - x); }

// Return 1 / x for normal x, relative error below 1e-6.
inline Floats reciprocal(Floats x) {
#if defined(__AVX512F__)
  Floats out;
  const __m512 guess = _mm512_rcp14_ps(x.v[0]);
  out.v[0] = guess * (2.0f - x.v[0] * guess);
  return out;
#else  // Narrower approximations differ between processor vendors.
  return Floats(1.0f) / x;
#endif
}

// Sixteen values at `p`, which is the start of a cache line, and the values on both sides of them.
// With AVX-512, shifted values are computed in registers, because a load that spans two cache lines
// takes twice as long.
class Neighbors {
 public:
#if defined(__AVX512F__)
  explicit Neighbors(const float* p)
      : left_(_mm512_load_si512(p - kLanes)),
        middle_(_mm512_load_si512(p)),
        right_(_mm512_load_si512(p + kLanes)) {}

  template <int Right>  // Values `Right` places to the right, or to the left if negative.
  [[gnu::always_inline]] inline Floats at() const {
    __m512i out = middle_;
    if constexpr (Right > 0) out = _mm512_alignr_epi32(right_, middle_, Right);
    if constexpr (Right < 0) out = _mm512_alignr_epi32(middle_, left_, kLanes + Right);
    Floats values;
    values.v[0] = _mm512_castsi512_ps(out);
    return values;
  }

 private:
  __m512i left_, middle_, right_;
#else
  explicit Neighbors(const float* p) : middle_(p) {}

  template <int Right>
  [[gnu::always_inline]] inline Floats at() const {
    return Floats::load(middle_ + Right);
  }

 private:
  const float* middle_;
#endif
};

inline Floats abs(Floats x) { return max(x, Floats(0.0f) - x); }

#if defined(__AVX2__)
struct SetBits {  // Set bits of every byte, from the lowest, and their number.
  struct {
    uint8_t index[8];
    uint8_t count;
  } of_byte[256] = {};
  constexpr SetBits() {
    for (int byte = 0; byte < 256; ++byte)
      for (int bit = 0; bit < 8; ++bit)
        if (byte >> bit & 1) of_byte[byte].index[of_byte[byte].count++] = bit;
  }
};
inline constexpr SetBits kSetBits;
#endif

// Write all i in [0, n) for which bit `bit` of words[i] is set, ascending, and return their number.
// The loop has no branches, because the bits follow no pattern that a processor could predict.
// `out` has room for n + kLanes values.
inline int indices_with_bit(const uint32_t* words, int n, int bit, uint32_t* out) {
  int count = 0;
#if defined(__AVX512F__)
  const __m512i wanted = _mm512_set1_epi32(1 << bit);
  __m512i index = _mm512_setr_epi32(0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15);
  for (int i = 0; i < n; i += kLanes, index = _mm512_add_epi32(index, _mm512_set1_epi32(kLanes))) {
    const __mmask16 inside = n - i < kLanes ? (1u << (n - i)) - 1 : 0xffff;
    const __mmask16 set =
        _mm512_test_epi32_mask(_mm512_maskz_loadu_epi32(inside, words + i), wanted);
    _mm512_storeu_si512(out + count, _mm512_maskz_compress_epi32(set, index));
    count += __builtin_popcount(set);
  }
#else
  int i = 0;
#if defined(__AVX2__)
  const __m256i wanted = _mm256_set1_epi32(1 << bit);
  for (; i + 8 <= n; i += 8) {
    const __m256i word = _mm256_loadu_si256(reinterpret_cast<const __m256i*>(words + i));
    const __m256i is_set = _mm256_cmpeq_epi32(_mm256_and_si256(word, wanted), wanted);
    const int set = _mm256_movemask_ps(_mm256_castsi256_ps(is_set));
    const __m128i lanes =
        _mm_loadl_epi64(reinterpret_cast<const __m128i*>(kSetBits.of_byte[set].index));
    const __m256i index = _mm256_add_epi32(_mm256_cvtepu8_epi32(lanes), _mm256_set1_epi32(i));
    _mm256_storeu_si256(reinterpret_cast<__m256i*>(out + count), index);
    count += kSetBits.of_byte[set].count;
  }
#endif
  for (; i < n; ++i) {
    out[count] = static_cast<uint32_t>(i);
    count += words[i] >> bit & 1;
  }
#endif
  return count;
}

}  // namespace ldo::LDO_ISA
