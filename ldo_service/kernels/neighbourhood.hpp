// Gaussians in voxels, and the few around each voxel that stand for its neighbourhood.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "buffer.hpp"
#include "labels.hpp"
#include "simd.hpp"

namespace ldo::LDO_ISA {

// Own voxel first, then those that share a face, an edge, a corner.
struct Stencil {
  int8_t step[27][3];
  constexpr Stencil() : step{} {
    int n = 0;
    for (int apart = 0; apart <= 3; ++apart)
      for (int x = -1; x <= 1; ++x)
        for (int y = -1; y <= 1; ++y)
          for (int z = -1; z <= 1; ++z)
            if (x * x + y * y + z * z == apart) {
              step[n][0] = static_cast<int8_t>(x);
              step[n][1] = static_cast<int8_t>(y);
              step[n++][2] = static_cast<int8_t>(z);
            }
  }
};
inline constexpr Stencil kStencil;

class Voxels {
 public:
  // Of the rows that `indices` [v] name: their places in that list, by voxel, in order. Voxels are
  // numbered as they appear. Rows that are not finite are in none.
  Voxels(const float* rows, const uint32_t* indices, int64_t v, float edge_m)
      : table_(table_size(v)), cell_of_(v), members_(v) {
    std::fill_n(table_.data(), table_.size(), -1);
    for (int64_t i = 0; i < v; ++i)
      cell_of_[i] = enter(rows + static_cast<int64_t>(indices[i]) * kRowFloats, 1.0f / edge_m);
    sort_members(v);
  }

  int64_t size() const { return static_cast<int64_t>(keys_.size()); }
  const uint32_t* begin(int64_t cell) const { return members_.data() + starts_[cell]; }
  int64_t count(int64_t cell) const { return starts_[cell + 1] - starts_[cell]; }

  // The voxels, ascending, that hold a member of which `is_one` is true, or touch one that does.
  template <class F>
  std::vector<int64_t> about(const F& is_one) const {
    std::vector<uint8_t> is_about(keys_.size(), 0);
    for (int64_t cell = 0; cell < size(); ++cell) {
      if (!std::any_of(begin(cell), begin(cell) + count(cell), is_one)) continue;
      for (const auto& step : kStencil.step) {
        const int64_t other = find(shifted(keys_[cell], step));
        if (other >= 0) is_about[other] = 1;
      }
    }
    std::vector<int64_t> out;
    for (int64_t cell = 0; cell < size(); ++cell)
      if (is_about[cell]) out.push_back(cell);
    return out;
  }

  // Up to sixteen Gaussians: the first eight of the voxel, then the first of each of those around
  // it, nearest voxels first, the second of each, and so on.
  int around(int64_t cell, uint32_t (&out)[kLanes]) const {
    int64_t cells[27], n_cells = 0, most = 0;
    for (const auto& step : kStencil.step) {
      const int64_t other = find(shifted(keys_[cell], step));
      if (other < 0 || other == cell) continue;
      cells[n_cells++] = other;
      most = std::max(most, count(other));
    }
    int n = 0;
    for (; n < std::min<int64_t>(kLanes / 2, count(cell)); ++n) out[n] = begin(cell)[n];
    for (int64_t turn = 0; turn < most && n < kLanes; ++turn)
      for (int64_t k = 0; k < n_cells && n < kLanes; ++k)
        if (turn < count(cells[k])) out[n++] = begin(cells[k])[turn];
    return n;
  }

 private:
  static constexpr int64_t kHalf = int64_t{1} << 20, kMask = (kHalf << 1) - 1;  // 21 bits an axis

  static size_t table_size(int64_t v) {
    size_t size = 64;
    while (size < 2 * static_cast<size_t>(v)) size *= 2;
    return size;
  }
  static uint64_t packed(int64_t x, int64_t y, int64_t z) {
    return static_cast<uint64_t>((x & kMask) << 42 | (y & kMask) << 21 | (z & kMask));
  }
  static uint64_t shifted(uint64_t key, const int8_t (&step)[3]) {
    const auto axis = [&](int shift) { return static_cast<int64_t>(key >> shift) & kMask; };
    return packed(axis(42) + step[0], axis(21) + step[1], axis(0) + step[2]);
  }
  size_t slot_of(uint64_t key) const {
    return static_cast<size_t>(key * 0x9e3779b97f4a7c15u >> 20) & (table_.size() - 1);
  }

  int32_t enter(const float* mean, float per_m) {
    int64_t at[3];
    for (int k = 0; k < 3; ++k) {
      const float cell = std::floor(mean[k] * per_m);
      if (!(std::fabs(cell) < static_cast<float>(kHalf))) return -1;
      at[k] = static_cast<int64_t>(cell) + kHalf;
    }
    const uint64_t key = packed(at[0], at[1], at[2]);
    size_t slot = slot_of(key);
    for (; table_[slot] >= 0; slot = (slot + 1) & (table_.size() - 1))
      if (keys_[table_[slot]] == key) return table_[slot];
    table_[slot] = static_cast<int32_t>(keys_.size());
    keys_.push_back(key);
    return table_[slot];
  }

  int64_t find(uint64_t key) const {
    for (size_t slot = slot_of(key); table_[slot] >= 0; slot = (slot + 1) & (table_.size() - 1))
      if (keys_[table_[slot]] == key) return table_[slot];
    return -1;
  }

  void sort_members(int64_t v) {
    starts_.assign(keys_.size() + 1, 0);
    for (int64_t i = 0; i < v; ++i)
      if (cell_of_[i] >= 0) ++starts_[cell_of_[i] + 1];
    for (size_t k = 1; k < starts_.size(); ++k) starts_[k] += starts_[k - 1];
    std::vector<int64_t> next(starts_.begin(), starts_.end() - 1);
    for (int64_t i = 0; i < v; ++i)
      if (cell_of_[i] >= 0) members_[next[cell_of_[i]]++] = static_cast<uint32_t>(i);
  }

  Buffer<int32_t> table_, cell_of_;
  Buffer<uint32_t> members_;
  std::vector<uint64_t> keys_;
  std::vector<int64_t> starts_;
};

}  // namespace ldo::LDO_ISA
