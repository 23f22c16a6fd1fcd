// Consistency step, which moves the label distributions of neighbors towards each other.
#pragma once
#include <limits>

#include "label_update.hpp"
#include "neighborhood.hpp"
#include "projection.hpp"

namespace ldo::LDO_ISA {

inline float background(const LabelRow& row) {
  float rest = 1.0f;
  for (float weight : row.weights) rest -= weight;
  return std::max(rest, 0.0f);
}

inline uint8_t top_label(const LabelRow& row) {
  return row.weights[0] > background(row) ? row.ids[0] : static_cast<uint8_t>(kBackground);
}

// Means and labels of at most sixteen neighboring Gaussians, one lane per Gaussian.
class Neighbors16 {
 public:
  Neighbors16(const float* rows, const uint32_t* indices, const LabelRow* labels,
              const uint32_t* places, int count) {
    for (auto& column : mean_) std::fill_n(column, kLanes, std::numeric_limits<float>::infinity());
    label_[0] = kBackground;
    std::fill_n(share_[0], kLanes, 0.0f);
    for (int j = 0; j < count; ++j) {
      const float* mean = rows + static_cast<int64_t>(indices[places[j]]) * kRowFloats;
      for (int k = 0; k < 3; ++k) mean_[k][j] = mean[k];
      add(labels[places[j]], j);
    }
  }

  int labels() const { return n_labels_; }  // Number of labels, including background.
  uint8_t label(int l) const { return label_[l]; }
  float share(int l, Floats weights) const { return sum(weights * Floats::load(share_[l])); }
  float differing(uint8_t top, Floats weights) const {
    const Floats tops = Floats::load(top_), own = static_cast<float>(top);
    return sum(select((tops >= own) & (own >= tops), 0.0f, weights));
  }

  // Return the weight exp(-d^2 / sigma^2) / n of each of the n Gaussians within the radius of
  // `mean`, and 0 for the others. The Gaussian in lane `self` is excluded; -1 excludes none.
  Floats weights(const float* mean, int self, const ConsistencyRule& rule) const {
    const Floats x = Floats::load(mean_[0]) - mean[0], y = Floats::load(mean_[1]) - mean[1],
                 z = Floats::load(mean_[2]) - mean[2];
    const Floats square = x * x + y * y + z * z;
    const Mask near = (square < rule.radius_m * rule.radius_m) &
                      (abs(Floats::ramp() - static_cast<float>(self)) >= 0.5f);
    const int n = __builtin_popcount(bits(near));
    if (n == 0) return 0.0f;
    const Floats kernel = exp(square * (-1.0f / (rule.sigma_m * rule.sigma_m)));
    return select(near, kernel, 0.0f) * (1.0f / static_cast<float>(n));
  }

 private:
  void add(const LabelRow& row, int j) {
    share_[0][j] = background(row);
    top_[j] = static_cast<float>(top_label(row));
    for (int k = 0; k < kSlots && row.weights[k] > 0.0f; ++k)
      share_[column_of(row.ids[k])][j] = row.weights[k];
  }
  int column_of(uint8_t id) {
    for (int l = 1; l < n_labels_; ++l)
      if (label_[l] == id) return l;
    std::fill_n(share_[n_labels_], kLanes, 0.0f);
    label_[n_labels_] = id;
    return n_labels_++;
  }

  static constexpr int kMost = 1 + kLanes * kSlots;
  alignas(64) float mean_[3][kLanes];  // Infinity in unused lanes, so that they are never near.
  alignas(64) float top_[kLanes] = {};
  int n_labels_ = 1;
  uint8_t label_[kMost];
  alignas(64) float share_[kMost][kLanes];
};

class ConsistencyStep {
 public:
  explicit ConsistencyStep(const ConsistencyRule& rule) : rule_(rule) {}

  // Update `row`, whose value before the step is `before`.
  void operator()(const Neighbors16& around, Floats weights, const LabelRow& before, LabelRow& row,
                  Disagreement& sums) const {
    const float mass = sum(weights);
    if (!(mass > 0.0f)) return;
    sums.literal += around.differing(top_label(before), weights);
    float agreed = background(before) * around.share(0, weights);
    Slots slots(row);
    slots.fade(1.0f - rule_.rate * mass);
    for (int l = 1; l < around.labels(); ++l) {
      const float share = around.share(l, weights);
      for (int k = 0; k < kSlots; ++k)
        if (before.ids[k] == around.label(l)) agreed += before.weights[k] * share;
      slots.add(around.label(l), rule_.rate * share);
    }
    sums.expected += mass - agreed;
  }

 private:
  const ConsistencyRule rule_;
};

}  // namespace ldo::LDO_ISA
