// Update of a Gaussian's label distribution by one observation.
#pragma once
#include <algorithm>
#include <cmath>

#include "labels.hpp"

namespace ldo::LDO_ISA {

// Label slots of a Gaussian, by descending weight; if weights are equal, the older label comes
// first. If all slots are taken, the weight of the lightest label is moved to the label `other`.
class Slots {
 public:
  explicit Slots(LabelRow& row) : row_(row) {}

  void fade(float factor) {
    for (float& weight : row_.weights) weight *= factor;
  }

  void add(uint8_t id, float weight) {
    if (id == kBackground || weight <= 0.0f) return;
    for (int k = 0; k < kSlots; ++k)
      if (row_.weights[k] > 0.0f && row_.ids[k] == id) return raise(k, row_.weights[k] + weight);
    const int last = kSlots - 1;
    if (row_.weights[last] == 0.0f) return place(last, id, weight);
    put_on_other(id, weight);
  }

 private:
  void raise(int k, float weight) { place(k, row_.ids[k], weight); }

  // Write a label to slot k, then move it before all slots of smaller weight.
  void place(int k, uint8_t id, float weight) {
    for (; k > 0 && row_.weights[k - 1] < weight; --k) {
      row_.weights[k] = row_.weights[k - 1];
      row_.ids[k] = row_.ids[k - 1];
    }
    row_.weights[k] = weight;
    row_.ids[k] = id;
  }

  // Add a label when all slots are taken: the weight of the lightest label, which may be the new
  // one, is moved to `other`.
  void put_on_other(uint8_t id, float weight) {
    int other = -1;
    for (int k = 0; k < kSlots; ++k)
      if (row_.ids[k] == kOther) other = k;
    if (other < 0) return merge_two_lightest(id, weight);
    const int lightest = other == kSlots - 1 ? kSlots - 2 : kSlots - 1;
    const float given = std::min(weight, row_.weights[lightest]);
    if (row_.weights[lightest] < weight) {
      remove(lightest);
      place(kSlots - 1, id, weight);
    }
    add(kOther, given);
  }

  // Create the slot of `other` from the two lightest of the five stored labels and the new label.
  void merge_two_lightest(uint8_t id, float weight) {
    const int last = kSlots - 1;
    float given = row_.weights[last] + weight;
    if (id != kOther && row_.weights[last - 1] < weight) {
      given = row_.weights[last] + row_.weights[last - 1];
      remove(last);
      remove(last - 1);
      place(last - 1, id, weight);
    } else {
      remove(last);
    }
    place(last, kOther, given);
  }

  void remove(int k) {
    for (; k + 1 < kSlots; ++k) {
      row_.weights[k] = row_.weights[k + 1];
      row_.ids[k] = row_.ids[k + 1];
    }
    row_.weights[kSlots - 1] = 0.0f;
    row_.ids[kSlots - 1] = kBackground;
  }

  LabelRow& row_;
};

// Return -sum p log p, in nats.
inline float entropy(const LabelRow& row) {
  float rest = 1.0f, sum = 0.0f;
  for (float p : row.weights) {
    rest -= p;
    if (p > 0.0f) sum -= p * std::log(p);
  }
  return rest > 0.0f ? sum - rest * std::log(rest) : sum;
}

class LabelUpdate {
 public:
  explicit LabelUpdate(const UpdateRule& rule) : rule_(rule) {}

  void operator()(LabelRow& row, int16_t label, float confidence, float extent_m) const {
    if (label >= 0)
      see(row, static_cast<uint8_t>(label), confidence, extent_m);
    else if (label == kMiss)
      rule_.is_corrected ? doubt(row, extent_m) : count(row);
  }

 private:
  void see(LabelRow& row, uint8_t id, float confidence, float extent_m) const {
    const float held = held_back(row, confidence);
    const float step =
        rule_.is_corrected ? step_of(row, held * confidence) : held * (1.0f - rule_.keep);
    Slots slots(row);
    slots.fade(1.0f - step);
    slots.add(id, step);
    row.extent_mm = static_cast<uint16_t>(std::min(1000.0f * extent_m, 65535.0f));
    row.misses = 0;
  }

  // Count a miss. If the object would appear large enough for the detector, reduce the weights of
  // the labels.
  void doubt(LabelRow& row, float extent_m) const {
    row.misses += row.misses < 255;
    const float known_m =
        row.extent_mm > 0 ? 0.001f * static_cast<float>(row.extent_mm) : rule_.usual_extent_m;
    if (!(known_m >= extent_m)) return;
    Slots(row).fade(1.0f - step_of(row, rule_.miss_weight));
  }

  void count(LabelRow& row) const {
    if (++row.misses < rule_.miss_limit) return;
    row = LabelRow{};
  }

  // Add the weight of an observation to the evidence, in which earlier observations fade by the
  // factor `keep`. Return the weight as a fraction of the new evidence.
  float step_of(LabelRow& row, float weight) const {
    if (!(weight > 0.0f)) return 0.0f;
    row.evidence = rule_.keep * row.evidence + weight;
    return weight / row.evidence;
  }

  // Return the factor on the step. It is below 1 for an observation with low confidence of a
  // Gaussian whose labels have a low entropy.
  float held_back(const LabelRow& row, float confidence) const {
    if (rule_.hold_back == 0.0f || row.weights[0] == 0.0f) return 1.0f;
    return 1.0f - rule_.hold_back * std::exp(-2.0f * entropy(row)) * (1.0f - confidence);
  }

  const UpdateRule rule_;
};

}  // namespace ldo::LDO_ISA
