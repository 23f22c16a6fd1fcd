// Binary images and their connected components.
#pragma once
#include <algorithm>
#include <cstdint>
#include <vector>

namespace ldo::LDO_ISA {

// Binary image with one bit per pixel.
class BitImage {
 public:
  BitImage(int width, int height)
      : width(width), height(height), words((width + 63) / 64), bits_(words * height, 0) {}

  const uint64_t* row(int y) const { return bits_.data() + y * words; }

  // Set those of the sixteen pixels from `column` whose bit is set in `lanes`. `column` is a
  // multiple of sixteen. Pixels beyond the image are not set.
  void set(int y, int column, uint32_t lanes) {
    lanes &= within(column, 0, width);
    bits_[y * words + column / 64] |= static_cast<uint64_t>(lanes) << column % 64;
  }
  void clear_others(int y, int column, uint32_t lanes) {
    bits_[y * words + column / 64] &= ~(static_cast<uint64_t>(~lanes & 0xffff) << column % 64);
  }
  // Return the bits of the sixteen pixels from `column` that lie in columns [left, right).
  static uint32_t within(int column, int left, int right) {
    const auto before = [&](int end) { return (1u << std::clamp(end - column, 0, 16)) - 1; };
    return before(right) & ~before(left);
  }

  const int width, height;
  const int64_t words;  // Words per row.

 private:
  std::vector<uint64_t> bits_;
};

// Components of an image, connected by the sides of pixels, as runs of columns. They are numbered
// from 1, in the order of their first pixels, row by row.
class Components {
 public:
  struct Run {
    int begin, end;  // Columns.
    int32_t part;
  };

  explicit Components(const BitImage& image) {
    size_t above = 0;
    for (int y = 0; y < image.height; ++y) {
      const size_t here = runs_.size();
      starts_.push_back(here);
      add_runs(image.row(y), image.words);
      join(above, here);
      above = here;
    }
    starts_.push_back(runs_.size());
    number();
  }

  int32_t count() const { return count_; }

  // Call f(run) for the runs of a row, from left to right.
  template <class F>
  void each_run(int y, F f) const {
    for (size_t k = starts_[y]; k < starts_[y + 1]; ++k) f(runs_[k]);
  }

 private:
  void add_runs(const uint64_t* row, int64_t words) {
    uint64_t last = 0;
    int begin = -1;
    for (int64_t w = 0; w < words; ++w) {
      uint64_t changes = row[w] ^ (row[w] << 1 | last);
      last = row[w] >> 63;
      for (; changes != 0; changes &= changes - 1) {
        const int column = static_cast<int>(64 * w) + __builtin_ctzll(changes);
        if (begin < 0)
          begin = column;
        else
          close(begin, column);
      }
    }
    if (begin >= 0) close(begin, static_cast<int>(64 * words));
  }
  void close(int& begin, int end) {
    runs_.push_back({begin, end, static_cast<int32_t>(runs_.size())});
    begin = -1;
  }

  // Connect the runs of a row with those of the row above (union-find). Until `number` is called,
  // `part` of a run is the index of an earlier connected run, or of the run itself.
  void join(size_t above, size_t here) {
    size_t first = above;
    for (size_t k = here; k < runs_.size(); ++k) {
      while (first < here && runs_[first].end <= runs_[k].begin) ++first;
      for (size_t j = first; j < here && runs_[j].begin < runs_[k].end; ++j) merge(j, k);
    }
  }
  void merge(size_t a, size_t b) {
    const int32_t x = root(static_cast<int32_t>(a)), y = root(static_cast<int32_t>(b));
    runs_[std::max(x, y)].part = std::min(x, y);
  }
  int32_t root(int32_t k) {
    for (; runs_[k].part != k; k = runs_[k].part) runs_[k].part = runs_[runs_[k].part].part;
    return k;
  }
  void number() {
    for (size_t k = 0; k < runs_.size(); ++k) {
      Run& run = runs_[k];
      run.part = run.part == static_cast<int32_t>(k) ? ++count_ : runs_[run.part].part;
    }
  }

  std::vector<Run> runs_;
  std::vector<size_t> starts_;  // First run of each row.
  int32_t count_ = 0;
};

}  // namespace ldo::LDO_ISA
