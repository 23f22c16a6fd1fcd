// Compensation of the camera's motion during a frame, compiled once per instruction set (LDO_ISA).
// The kernels run on one thread. Each row takes three steps: the displacement of its pixels, the
// places that they are read from, and the interpolation. Pixels that do not lie side by side are
// read one by one; the rest is vectorized. The compiler does not vectorize a loop after it is
// inlined and `__restrict` is lost.
#include "shutter.hpp"

#include <algorithm>
#include <cmath>
#include <cstring>
#include <vector>

namespace ldo::LDO_ISA {
namespace {

constexpr float kCenter = (kCellPx - 1) / 2.0f;  // Center of the first cell.
// Image motion in rows per row of the readout; the image would fold beyond 1.
constexpr float kMaxRowShift = 0.5f;

// Return the median depth of the cells that have depth; 0 if there are none.
float median(std::vector<float> known) {
  if (known.empty()) return 0.0f;
  const std::size_t half = known.size() / 2;
  std::nth_element(known.begin(), known.begin() + half, known.end());
  const float upper = known[half];
  if (known.size() % 2 == 1) return upper;
  return 0.5f * (upper + *std::max_element(known.begin(), known.begin() + half));
}

// Return the inverse depth [rows, columns] at the cells; that of the median depth where unknown.
std::vector<float> inverse_depths(const float* depth, const MovingCamera& camera) {
  const int rows = camera.rows(), columns = camera.columns();
  std::vector<float> values(static_cast<std::size_t>(rows) * columns, 0.0f), known;
  known.reserve(values.size());
  for (int i = 0; i < rows; ++i) {
    for (int j = 0; j < columns; ++j) {
      const int v = i * kCellPx + kCellPx / 2, u = j * kCellPx + kCellPx / 2;
      if (v >= camera.height || u >= camera.width) continue;
      const float z = depth[static_cast<std::int64_t>(v) * camera.width + u];
      if (!(z > 0)) continue;
      values[i * columns + j] = z;
      known.push_back(z);
    }
  }
  const float usual = median(known);
  for (float& z : values) {
    const float depth_m = z > 0 ? z : usual;
    z = depth_m > 0 ? 1.0f / depth_m : 0.0f;
  }
  return values;
}

// Return when a surface point was recorded. `v` is its row at the middle of the frame. If it moves
// downwards, it is recorded in a lower row. Lower rows are recorded later, so it moves further.
float time_of(float v, float flow_v, float readout_s, float delay_s, int height) {
  const float row_s = readout_s / std::max(height - 1, 1);
  const float shift = std::clamp(flow_v * row_s, -kMaxRowShift, kMaxRowShift);
  return ((v - (height - 1) / 2.0f) * row_s + delay_s) / (1.0f - shift);
}

// Values at the cells, [rows, columns], which are interpolated between their centers.
class Grid {
 public:
  explicit Grid(const MovingCamera& camera)
      : rows_(camera.rows()),
        columns_(camera.columns()),
        values_(static_cast<std::size_t>(rows_) * columns_),
        line_(columns_ + 2),
        pixels_(static_cast<std::size_t>(columns_ + 1) * kCellPx) {}

  float& operator()(int i, int j) { return values_[static_cast<std::size_t>(i) * columns_ + j]; }

  // Return the values of a row of pixels. The next call overwrites them.
  const float* row(int v) {
    const float place = std::clamp((v - kCenter) / kCellPx, 0.0f, static_cast<float>(rows_ - 1));
    const int above = static_cast<int>(place), below = std::min(above + 1, rows_ - 1);
    const float weight = place - above;
    const float* a = &(*this)(above, 0);
    const float* b = &(*this)(below, 0);
    for (int j = 0; j < columns_; ++j) line_[j + 1] = a[j] + weight * (b[j] - a[j]);
    line_[0] = line_[1], line_[columns_ + 1] = line_[columns_];
    for (int j = 0; j <= columns_; ++j) {
      const float left = line_[j], slope = (line_[j + 1] - left) / kCellPx;
      float* run = pixels_.data() + static_cast<std::size_t>(j) * kCellPx;
      for (int k = 0; k < kCellPx; ++k) run[k] = left + (k + 0.5f) * slope;
    }
    return pixels_.data() + kCellPx / 2;
  }

 private:
  const int rows_, columns_;
  std::vector<float> values_;
  std::vector<float> line_;    // Values of one row of pixels at the columns of the cells.
  std::vector<float> pixels_;  // Values of the row, the first half a cell before its first pixel.
};

// Displacement of the pixels in color and in depth, and the relative change of depth.
struct Displacement {
  Grid color_u, color_v, depth_u, depth_v, depth_change;

  Displacement(const float* depth, const MovingCamera& camera, const RowTimes& t)
      : color_u(camera), color_v(camera), depth_u(camera), depth_v(camera), depth_change(camera) {
    const int rows = camera.rows(), columns = camera.columns();
    const int cells = rows * columns;
    std::vector<float> motion(static_cast<std::size_t>(kMotionPlanes) * cells);
    image_motion(depth, camera, motion.data());
    for (int i = 0; i < rows; ++i) {
      const float v = i * kCellPx + kCenter;
      for (int j = 0; j < columns; ++j) {
        const float* cell = motion.data() + i * columns + j;
        const float flow_u = cell[0], flow_v = cell[cells], z_per_s = cell[2 * cells];
        const float color_s = time_of(v, flow_v, t.readout_s, 0.0f, camera.height);
        const float depth_s = time_of(v, flow_v, t.depth_readout_s, t.depth_delay_s, camera.height);
        color_u(i, j) = flow_u * color_s, color_v(i, j) = flow_v * color_s;
        depth_u(i, j) = flow_u * depth_s, depth_v(i, j) = flow_v * depth_s;
        depth_change(i, j) = z_per_s * depth_s;
      }
    }
  }
};

float clamped(float value, float most) {
  const float positive = value > 0 ? value : 0.0f;
  return positive < most ? positive : most;
}

// Places between the pixels of an image that a row is read from.
struct Places {
  std::vector<int> corner;                // Index of the pixel above and to the left.
  std::vector<int> right, below;          // Steps to the other pixels; 0 where their weight is 0.
  std::vector<int> inside;                // 1 if the place is in the image.
  std::vector<float> weight_u, weight_v;  // Weights of the right and of the lower pixels.

  explicit Places(int width)
      : corner(width),
        right(width),
        below(width),
        inside(width),
        weight_u(width),
        weight_v(width) {}
};

__attribute__((noinline)) void find_places(int v, const float* __restrict shift_u,
                                           const float* __restrict shift_v, int width, int height,
                                           int* __restrict corner, int* __restrict right,
                                           int* __restrict below, int* __restrict inside,
                                           float* __restrict weight_u, float* __restrict weight_v) {
  const float last_u = width - 1.0f, last_v = height - 1.0f;
  for (int u = 0; u < width; ++u) {
    const float x = u + shift_u[u], y = v + shift_v[u];
    const float su = clamped(x, last_u), sv = clamped(y, last_v);
    const int iu = static_cast<int>(su), iv = static_cast<int>(sv);
    const float wu = su - iu, wv = sv - iv;
    corner[u] = iv * width + iu;
    right[u] = wu > 0 ? 1 : 0, below[u] = wv > 0 ? width : 0;
    inside[u] = (su == x) & (sv == y) ? 1 : 0;
    weight_u[u] = wu, weight_v[u] = wv;
  }
}

// Consecutive pixels of a row that are read at once if their places are side by side. The image
// motion is smooth, so this is true of most pixels.
constexpr int kRun = 16;

// Return whether the indices of kRun pixels ascend by one.
bool ascends(const int* index) {
  int differs = 0;
  for (int k = 0; k < kRun; ++k) differs |= index[k] - index[0] - k;
  return differs == 0;
}

bool is_constant(const int* values) {
  int differs = 0;
  for (int k = 0; k < kRun; ++k) differs |= values[k] - values[0];
  return differs == 0;
}

// The four pixels around each place, with all channels, and 1 if none of them is missing.
struct Taps {
  std::vector<std::uint8_t> upper_left, upper_right, lower_left, lower_right, valid;

  explicit Taps(int values, int width)
      : upper_left(values),
        upper_right(values),
        lower_left(values),
        lower_right(values),
        valid(width) {}
};

// Copy the pixels around the places `u` to `u + n - 1`, which are side by side.
template <int channels, int n>
[[gnu::always_inline]] inline void copy_taps(const std::uint8_t* image, int u, const Places& places,
                                             Taps& t) {
  const std::uint8_t* a = image + channels * places.corner[u];
  const std::uint8_t* b = a + channels * places.right[u];
  const int below = channels * places.below[u];
  std::memcpy(t.upper_left.data() + channels * u, a, channels * n);
  std::memcpy(t.upper_right.data() + channels * u, b, channels * n);
  std::memcpy(t.lower_left.data() + channels * u, a + below, channels * n);
  std::memcpy(t.lower_right.data() + channels * u, b + below, channels * n);
}

// Return 1 if a pixel is not black.
template <int channels>
int lit(const std::uint8_t* pixel) {
  int any = 0;
  for (int k = 0; k < channels; ++k) any |= pixel[k];
  return any != 0;
}

template <int channels>
__attribute__((noinline)) void find_valid(const std::uint8_t* __restrict a,
                                          const std::uint8_t* __restrict b,
                                          const std::uint8_t* __restrict c,
                                          const std::uint8_t* __restrict d,
                                          const int* __restrict inside, int width,
                                          std::uint8_t* __restrict valid) {
  for (int u = 0; u < width; ++u) {
    const int i = channels * u;
    valid[u] = lit<channels>(a + i) & lit<channels>(b + i) & lit<channels>(c + i) &
               lit<channels>(d + i) & inside[u];
  }
}

template <int channels>
void read_taps(const std::uint8_t* image, int width, const Places& places, Taps& t) {
  const int *corner = places.corner.data(), *right = places.right.data();
  const int* below = places.below.data();
  for (int first = 0; first < width; first += kRun) {
    if (first + kRun <= width && ascends(corner + first) && is_constant(right + first) &&
        is_constant(below + first)) {
      copy_taps<channels, kRun>(image, first, places, t);
      continue;
    }
    const int end = std::min(first + kRun, width);
    for (int u = first; u < end; ++u) copy_taps<channels, 1>(image, u, places, t);
  }
  find_valid<channels>(t.upper_left.data(), t.upper_right.data(), t.lower_left.data(),
                       t.lower_right.data(), places.inside.data(), width, t.valid.data());
}

// Interpolate a row. A pixel that mixes with a missing one is missing.
template <int channels>
__attribute__((noinline)) void interpolate(
    const std::uint8_t* __restrict upper_left, const std::uint8_t* __restrict upper_right,
    const std::uint8_t* __restrict lower_left, const std::uint8_t* __restrict lower_right,
    const std::uint8_t* __restrict valid, const float* __restrict weight_u,
    const float* __restrict weight_v, int width, std::uint8_t* __restrict out) {
  for (int u = 0; u < width; ++u) {
    for (int k = 0; k < channels; ++k) {
      const int i = channels * u + k;
      const float a = upper_left[i], b = upper_right[i], c = lower_left[i], d = lower_right[i];
      const float upper = a + weight_u[u] * (b - a), lower = c + weight_u[u] * (d - c);
      const int value = static_cast<int>(upper + weight_v[u] * (lower - upper) + 0.5f);
      out[i] = static_cast<std::uint8_t>(value * valid[u]);
    }
  }
}

template <int channels>
void read_color(const std::uint8_t* image, int width, const Places& places, Taps& t,
                std::uint8_t* out) {
  read_taps<channels>(image, width, places, t);
  interpolate<channels>(t.upper_left.data(), t.upper_right.data(), t.lower_left.data(),
                        t.lower_right.data(), t.valid.data(), places.weight_u.data(),
                        places.weight_v.data(), width, out);
}

// Pixels of a depth image that a row is read from.
struct NearestPixels {
  std::vector<int> index;
  std::vector<int> inside;  // 1 if the place is in the image.
  std::vector<float> depth;

  explicit NearestPixels(int width) : index(width), inside(width), depth(width) {}
};

__attribute__((noinline)) void find_nearest(int v, const float* __restrict shift_u,
                                            const float* __restrict shift_v, int width, int height,
                                            int* __restrict index, int* __restrict inside) {
  const float last_u = width - 1.0f, last_v = height - 1.0f;
  for (int u = 0; u < width; ++u) {
    const float x = u + shift_u[u], y = v + shift_v[u];
    const float su = clamped(x, last_u), sv = clamped(y, last_v);
    const int iu = static_cast<int>(su + 0.5f), iv = static_cast<int>(sv + 0.5f);
    index[u] = iv * width + iu;
    inside[u] = (std::fabs(x - su) < 0.5f) & (std::fabs(y - sv) < 0.5f) ? 1 : 0;
  }
}

__attribute__((noinline)) void change_depth(const float* __restrict depth,
                                            const int* __restrict inside,
                                            const float* __restrict change, int width,
                                            float* __restrict out) {
  for (int u = 0; u < width; ++u) {
    const float z = depth[u];
    out[u] = (inside[u] != 0) & (z > 0) ? z * (1.0f - change[u]) : 0.0f;
  }
}

// Read a row of depth from the nearest pixels.
void read_depth(const float* depth, int v, const float* shift_u, const float* shift_v,
                const float* change, int width, int height, NearestPixels& p, float* out) {
  find_nearest(v, shift_u, shift_v, width, height, p.index.data(), p.inside.data());
  for (int first = 0; first < width; first += kRun) {
    const int* index = p.index.data() + first;
    float* values = p.depth.data() + first;
    if (first + kRun <= width && ascends(index)) {
      std::memcpy(values, depth + index[0], sizeof(float) * kRun);
      continue;
    }
    const int n = std::min(kRun, width - first);
    for (int k = 0; k < n; ++k) values[k] = depth[index[k]];
  }
  change_depth(p.depth.data(), p.inside.data(), change, width, out);
}

}  // namespace

void image_motion(const float* depth, const MovingCamera& camera, float* motion) {
  const int rows = camera.rows(), columns = camera.columns(), cells = rows * columns;
  const std::vector<float> inverse = inverse_depths(depth, camera);
  const float rx = camera.velocity[0], ry = camera.velocity[1], rz = camera.velocity[2];
  const float tx = camera.velocity[3], ty = camera.velocity[4], tz = camera.velocity[5];
  for (int i = 0; i < rows; ++i) {
    const float y = (i * kCellPx + kCenter - camera.cy) / camera.fy;
    for (int j = 0; j < columns; ++j) {
      const float x = (j * kCellPx + kCenter - camera.cx) / camera.fx;
      const int cell = i * columns + j;
      // A point X has the velocity -(t + r x X) in the camera frame.
      const float z_per_s = -(tz * inverse[cell] + rx * y - ry * x);
      motion[cell] = camera.fx * (-(tx * inverse[cell] + ry - rz * y) - x * z_per_s);
      motion[cells + cell] = camera.fy * (-(ty * inverse[cell] + rz * x - rx) - y * z_per_s);
      motion[2 * cells + cell] = z_per_s;
    }
  }
}

void warp(const Frame& frame, int channels, const MovingCamera& camera, const RowTimes& t,
          const WarpedFrame& out) {
  const int width = camera.width, height = camera.height;
  Displacement shift(frame.depth, camera, t);
  Places p(width);
  Taps taps(channels * width, width);
  NearestPixels nearest(width);
  const auto read_row = channels == 1 ? read_color<1> : read_color<3>;
  for (int v = 0; v < height; ++v) {
    const std::int64_t row = static_cast<std::int64_t>(v) * width;
    find_places(v, shift.color_u.row(v), shift.color_v.row(v), width, height, p.corner.data(),
                p.right.data(), p.below.data(), p.inside.data(), p.weight_u.data(),
                p.weight_v.data());
    read_row(frame.image, width, p, taps, out.image + channels * row);
    read_depth(frame.depth, v, shift.depth_u.row(v), shift.depth_v.row(v),
               shift.depth_change.row(v), width, height, nearest, out.depth + row);
  }
}

}  // namespace ldo::LDO_ISA
