// Gaussians in voxels, and a sample of the Gaussians around each voxel.
#pragma once
#include <algorithm>
#include <cmath>
#include <vector>

#include "buffer.hpp"
#include "labels.hpp"
#include "simd.hpp"

namespace ldo::LDO_ISA {

// Steps from a voxel to itself, then to the voxels that share a face, an edge or a corner with it,
// in this order.
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

constexpr int64_t kOwn = kLanes / 2;  // Maximum number of Gaussians sampled from the voxel itself.

class Voxels {
 public:
  // Sort the rows `indices` [v] into voxels. The members of a voxel are positions in that list,
  // ascending. Voxels are numbered in order of appearance. Rows that are not finite belong to no
  // voxel.
  Voxels(const float* rows, const uint32_t* indices, int64_t v, float edge_m)
      : table_(size_t{1} << table_bits_, -1), cell_of_(v), members_(v) {
    // Keys are computed in blocks of 64, so that loads of rows do not wait for the branches in
    // `enter`.
    uint64_t keys[64];
    for (int64_t begin = 0; begin < v; begin += 64) {
      const int64_t n = std::min<int64_t>(64, v - begin);
      for (int64_t i = 0; i < n; ++i)
        keys[i] =
            key_of(rows + static_cast<int64_t>(indices[begin + i]) * kRowFloats, 1.0f / edge_m);
      for (int64_t i = 0; i < n; ++i) {
        const int32_t cell = cell_of_[begin + i] = enter(keys[i]);
        if (cell >= 0) ++starts_[cell + 1];
      }
    }
    sort_members(v);
  }

  int64_t size() const { return static_cast<int64_t>(keys_.size()); }
  const uint32_t* begin(int64_t cell) const { return members_.data() + starts_[cell]; }
  int64_t count(int64_t cell) const { return starts_[cell + 1] - starts_[cell]; }

  // Return the voxels that have a member for which `is_one` is true, and all voxels that touch such
  // a voxel, ascending.
  template <class F>
  std::vector<int64_t> about(const F& is_one) const {
    std::vector<uint8_t> has_one(keys_.size(), 0), is_about(keys_.size(), 0);
    for (size_t i = 0; i < cell_of_.size(); ++i)  // Memory order, not voxel order.
      if (cell_of_[i] >= 0 && is_one(static_cast<uint32_t>(i))) has_one[cell_of_[i]] = 1;
    for (int64_t cell = 0; cell < size(); ++cell) {
      if (!has_one[cell]) continue;
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

  // Write at most sixteen Gaussians to `out` and return their number. The first kOwn Gaussians of
  // the voxel itself come first. Then follow the first Gaussian of each voxel around it, nearest
  // voxels first, then the second Gaussian of each, and so on.
  int around(int64_t cell, uint32_t (&out)[kLanes]) const {
    int64_t cells[27], n_cells = 0, most = 0;
    for (const auto& step : kStencil.step) {
      const int64_t other = find(shifted(keys_[cell], step));
      if (other < 0 || other == cell) continue;
      cells[n_cells++] = other;
      most = std::max(most, count(other));
    }
    int n = 0;
    for (; n < std::min(kOwn, count(cell)); ++n) out[n] = begin(cell)[n];
    for (int64_t turn = 0; turn < most && n < kLanes; ++turn)
      for (int64_t k = 0; k < n_cells && n < kLanes; ++k)
        if (turn < count(cells[k])) out[n++] = begin(cells[k])[turn];
    return n;
  }

 private:
  static constexpr int64_t kHalf = int64_t{1} << 20, kMask = (kHalf << 1) - 1;  // 21 bits per axis.
  static constexpr uint64_t kNowhere = ~uint64_t{0};

  static uint64_t packed(int64_t x, int64_t y, int64_t z) {
    return static_cast<uint64_t>((x & kMask) << 42 | (y & kMask) << 21 | (z & kMask));
  }
  static uint64_t shifted(uint64_t key, const int8_t (&step)[3]) {
    const auto axis = [&](int shift) { return static_cast<int64_t>(key >> shift) & kMask; };
    return packed(axis(42) + step[0], axis(21) + step[1], axis(0) + step[2]);
  }
  // Return the first slot of the table to try for a key. It is taken from the highest bits of the
  // product, because the lower bits do not depend on x.
  size_t slot_of(uint64_t key) const {
    return static_cast<size_t>(key * 0x9e3779b97f4a7c15u >> (64 - table_bits_));
  }

  static uint64_t key_of(const float* mean, float per_m) {
    int64_t at[3];
    bool is_near = true;
    for (int k = 0; k < 3; ++k) {
      const float cell = std::floor(mean[k] * per_m);
      const bool is_in = std::fabs(cell) < static_cast<float>(kHalf);
      at[k] = static_cast<int64_t>(is_in ? cell : 0.0f) + kHalf;
      is_near = is_near & is_in;
    }
    return is_near ? packed(at[0], at[1], at[2]) : kNowhere;
  }

  int32_t enter(uint64_t key) {
    if (key == kNowhere) return -1;
    const size_t slot = slot_for(key);
    return table_[slot] >= 0 ? table_[slot] : added(key, slot);
  }

  // Add a voxel to the table. The table has an entry per voxel, not per Gaussian, so that it fits
  // in the cache. At least three of four slots are empty, so that most lookups need one attempt. A
  // mispredicted branch takes more time than the additional memory.
  int32_t added(uint64_t key, size_t slot) {
    const int32_t cell = static_cast<int32_t>(keys_.size());
    keys_.push_back(key);
    starts_.push_back(0);
    table_[slot] = cell;
    if (4 * keys_.size() > table_.size()) {
      table_.assign(size_t{1} << ++table_bits_, -1);
      for (size_t k = 0; k < keys_.size(); ++k)
        table_[slot_for(keys_[k])] = static_cast<int32_t>(k);
    }
    return cell;
  }

  // Return the slot of a voxel in the table, or the slot where it would be.
  size_t slot_for(uint64_t key) const {
    size_t slot = slot_of(key);
    while (table_[slot] >= 0 && keys_[table_[slot]] != key) slot = (slot + 1) & (table_.size() - 1);
    return slot;
  }
  int64_t find(uint64_t key) const { return table_[slot_for(key)]; }

  void sort_members(int64_t v) {
    for (size_t k = 1; k < starts_.size(); ++k) starts_[k] += starts_[k - 1];
    std::vector<int64_t> next(starts_.begin(), starts_.end() - 1);
    for (int64_t i = 0; i < v; ++i)
      if (cell_of_[i] >= 0) members_[next[cell_of_[i]]++] = static_cast<uint32_t>(i);
  }

  int table_bits_ = 6;
  std::vector<int32_t> table_;  // Voxels by key; -1 in an empty slot.
  Buffer<int32_t> cell_of_;
  Buffer<uint32_t> members_;
  std::vector<uint64_t> keys_;
  std::vector<int64_t> starts_{0};
};

}  // namespace ldo::LDO_ISA
