// The kernels run on one thread in a fixed order. Points are processed in blocks. Each block passes
// four vectorized steps: project, sample, weigh, accumulate. Block sums are added in double
// precision.
#include "align.hpp"

#include <cmath>
#include <cstring>
#include <vector>

#include "transpose.hpp"

namespace ldo::align {
namespace {

using namespace ldo::LDO_ISA;

constexpr int kBlock = 256, kChunk = 64;
// Degrees of freedom of the t-distribution (Kerl et al. 2013, III.B).
constexpr float kDegrees = 5.0f;
constexpr float kInlierSigma = 3.0f;
constexpr float kNearest = 1e-3f;  // Meters; closer points are not projected.

constexpr float kAnyDifference = 1e3f;  // Relative tolerance that excludes no gray level.

float smaller(float a, float b) { return a < b ? a : b; }
float larger(float a, float b) { return a > b ? a : b; }

// Average the 2x2 blocks of two rows to a row of `w` values.
__attribute__((noinline)) void halve_rows(const float* __restrict upper,
                                          const float* __restrict lower, int w, float tolerance,
                                          int least, float* __restrict row) {
  const float missing = 1e30f, reach = 1.0f + tolerance, fewest = static_cast<float>(least);
  for (int x = 0; x < w; ++x) {
    const float a = upper[2 * x], b = upper[2 * x + 1], c = lower[2 * x], d = lower[2 * x + 1];
    const float nearest = smaller(smaller(a > 0 ? a : missing, b > 0 ? b : missing),
                                  smaller(c > 0 ? c : missing, d > 0 ? d : missing));
    const float limit = nearest * reach;
    const float wa = (a > 0) & (a <= limit) ? 1.0f : 0.0f;
    const float wb = (b > 0) & (b <= limit) ? 1.0f : 0.0f;
    const float wc = (c > 0) & (c <= limit) ? 1.0f : 0.0f;
    const float wd = (d > 0) & (d <= limit) ? 1.0f : 0.0f;
    const float count = wa + wb + wc + wd, sum = wa * a + wb * b + wc * c + wd * d;
    row[x] = count >= fewest ? sum / larger(count, 1.0f) : 0.0f;
  }
}

void halve(const float* values, int width, int height, float tolerance, int least, float* out) {
  const int w = width / 2;
  for (int y = 0; y < height / 2; ++y) {
    const float* upper = values + static_cast<std::int64_t>(2 * y) * width;
    halve_rows(upper, upper + width, w, tolerance, least, out + static_cast<std::int64_t>(y) * w);
  }
}

// Convert gray levels to values; clipped ones become 0.
__attribute__((noinline)) void expose(const std::uint8_t* __restrict gray, int n, int clipped,
                                      float* __restrict values) {
  for (int i = 0; i < n; ++i) {
    const int level = gray[i];
    values[i] = static_cast<float>(level < clipped ? level : 0);
  }
}

void halve_gray(const std::uint8_t* gray, int width, int height, int clipped, int least,
                float* out) {
  const int w = width / 2;
  std::vector<float> rows(2 * static_cast<std::size_t>(width));
  for (int y = 0; y < height / 2; ++y) {
    expose(gray + static_cast<std::int64_t>(2 * y) * width, 2 * width, clipped, rows.data());
    halve_rows(rows.data(), rows.data() + width, w, kAnyDifference, least,
               out + static_cast<std::int64_t>(y) * w);
  }
}

// Return the central difference per pixel; 0 if either value is 0, which marks a clipped pixel.
float difference(float after, float before) {
  return (after > 0) & (before > 0) ? 0.5f * (after - before) : 0.0f;
}

void pack(const float* image, const float* depth, int width, int height, float max_depth,
          float* out) {
  std::memset(out, 0, sizeof(float) * kTexelSize * width * height);
  for (int y = 0; y < height; ++y) {
    const std::int64_t start = static_cast<std::int64_t>(y) * width;
    const bool inside = y > 0 && y + 1 < height;
    for (int x = 0; x < width; ++x) {
      const std::int64_t i = start + x;
      float* texel = out + kTexelSize * i;
      texel[kIntensity] = image[i];
      texel[kDepth] = depth[i] <= max_depth ? depth[i] : 0.0f;
      if (inside && x > 0 && x + 1 < width) {
        texel[kGradientU] = difference(image[i + 1], image[i - 1]);
        texel[kGradientV] = difference(image[i + width], image[i - width]);
      }
    }
  }
}

// Return the maximum depth difference between a pixel and its neighbors on the same surface.
float surface_step(float depth, int radius) { return 0.015f * radius * depth + 0.01f; }

bool on_surface(float depth, float neighbor, float step) {
  return neighbor > 0 && std::fabs(neighbor - depth) <= step;
}

void normals(const float* depth, int width, int height, const Pinhole& camera, int radius,
             float* out) {
  std::memset(out, 0, sizeof(float) * 3 * width * height);
  const float ifx = 1.0f / camera.fx, ify = 1.0f / camera.fy;
  for (int y = radius; y < height - radius; ++y) {
    for (int x = radius; x < width - radius; ++x) {
      const std::int64_t i = static_cast<std::int64_t>(y) * width + x;
      const float z = depth[i], left = depth[i - radius], right = depth[i + radius];
      const float up = depth[i - static_cast<std::int64_t>(radius) * width];
      const float down = depth[i + static_cast<std::int64_t>(radius) * width];
      const float step = surface_step(z, radius);
      if (z <= 0 || !on_surface(z, left, step) || !on_surface(z, right, step) ||
          !on_surface(z, up, step) || !on_surface(z, down, step))
        continue;
      const float rx = (x - camera.cx) * ifx, ry = (y - camera.cy) * ify;
      const float az = right - left, bz = down - up;  // Vector a points along u, vector b along v.
      const float ax = rx * az + radius * ifx * (right + left), ay = ry * az;
      const float bx = rx * bz, by = ry * bz + radius * ify * (down + up);
      const float nx = ay * bz - az * by, ny = az * bx - ax * bz, nz = ax * by - ay * bx;
      const float length = std::sqrt(nx * nx + ny * ny + nz * nz);
      if (!(length > 0)) continue;
      const float scale = (nx * rx + ny * ry + nz > 0 ? -1.0f : 1.0f) / length;
      out[3 * i] = nx * scale, out[3 * i + 1] = ny * scale, out[3 * i + 2] = nz * scale;
    }
  }
}

std::int64_t points(const float* texels, const float* normals, int width, int height,
                    const Pinhole& camera, std::int64_t capacity, float* points) {
  const float ifx = 1.0f / camera.fx, ify = 1.0f / camera.fy;
  std::int64_t n = 0;
  for (int y = 1; y < height - 1; ++y) {
    for (int x = 1; x < width - 1; ++x) {
      const std::int64_t i = static_cast<std::int64_t>(y) * width + x;
      const float z = texels[kTexelSize * i + kDepth];
      if (!(z > kNearest)) continue;
      points[kX * capacity + n] = (x - camera.cx) * ifx * z;
      points[kY * capacity + n] = (y - camera.cy) * ify * z;
      points[kZ * capacity + n] = z;
      points[kShade * capacity + n] = texels[kTexelSize * i + kIntensity];
      for (int k = 0; k < 3; ++k) points[(kNormalX + k) * capacity + n] = normals[3 * i + k];
      ++n;
    }
  }
  return n;
}

// Values of one block of points. Its points are processed in chunks, whose intermediate values fit
// into the fastest cache beside the values of the block.
struct alignas(64) Block {
  // sqrt(w) [J | r] of the photometric residuals, then of the geometric residuals.
  float rows[kUnknowns + 1][2 * kBlock];
  float visible[kBlock];
  // Three values of each residual: 1 if it is used, 1 if it is an inlier, and w (r/sigma)^2.
  float photometric[3][kBlock], geometric[3][kBlock];
  // Intermediate values of a chunk.
  float x[kChunk], y[kChunk], z[kChunk];  // Target camera frame.
  float inverse_z[kChunk];
  float du[kChunk], dv[kChunk];         // Fractions of the bilinear sample.
  int corner[kChunk], nearest[kChunk];  // Texel indices.
  float column[kChunk], row[kChunk];    // Nearest pixel.
  float intensity[kChunk], gradient_u[kChunk], gradient_v[kChunk], depth[kChunk];
  const float* point[kPointRows];  // Reference frame, as stored.
  float last[kPointRows][kBlock];  // Points of the last block, filled up with zeros.
};

void load(const Problem& p, std::int64_t first, Block& b) {
  const std::int64_t left = p.count - first;
  for (int k = 0; k < kPointRows; ++k) {
    const float* values = p.points + k * p.count + first;
    b.point[k] = values;
    if (left >= kBlock) continue;
    const int n = static_cast<int>(left);
    std::memcpy(b.last[k], values, sizeof(float) * n);
    std::memset(b.last[k] + n, 0, sizeof(float) * (kBlock - n));
    b.point[k] = b.last[k];
  }
}

void project(const Problem& p, int first, Block& b) {
  const float* T = p.T_camera_reference;
  const float right = p.width - 2.0f, bottom = p.height - 2.0f;
  const float *points_x = b.point[kX] + first, *points_y = b.point[kY] + first,
              *points_z = b.point[kZ] + first;
#pragma GCC ivdep
  for (int i = 0; i < kChunk; ++i) {
    const float X = points_x[i], Y = points_y[i], Z = points_z[i];
    const float x = T[0] * X + T[1] * Y + T[2] * Z + T[3];
    const float y = T[4] * X + T[5] * Y + T[6] * Z + T[7];
    const float z = T[8] * X + T[9] * Y + T[10] * Z + T[11];
    const bool in_front = (Z > 0) & (z > kNearest);
    const float inverse = 1.0f / (in_front ? z : 1.0f);
    const float u = p.camera.fx * x * inverse + p.camera.cx;
    const float v = p.camera.fy * y * inverse + p.camera.cy;
    const bool inside = in_front & (u >= 1.0f) & (v >= 1.0f) & (u < right) & (v < bottom);
    const float su = inside ? u : 0.0f, sv = inside ? v : 0.0f;
    const int iu = static_cast<int>(su), iv = static_cast<int>(sv);
    const int nu = static_cast<int>(su + 0.5f), nv = static_cast<int>(sv + 0.5f);
    b.x[i] = x, b.y[i] = y, b.z[i] = in_front ? z : 1.0f;
    b.inverse_z[i] = inverse;
    b.du[i] = su - iu, b.dv[i] = sv - iv;
    b.corner[i] = iv * p.width + iu, b.nearest[i] = nv * p.width + nu;
    b.column[i] = static_cast<float>(nu), b.row[i] = static_cast<float>(nv);
    b.visible[first + i] = inside ? 1.0f : 0.0f;
  }
}

// Return whether a point of a chunk is inside the image.
bool shows_points(int first, const Block& b) {
  float sum = 0.0f;
  for (int i = 0; i < kChunk; ++i) sum += b.visible[first + i];
  return sum > 0.0f;
}

// Set the values of a chunk to 0, which are those of points outside the image.
void clear(int first, Block& b) {
  constexpr std::size_t size = sizeof(float) * kChunk;
  for (float* row : b.rows) {
    std::memset(row + first, 0, size);
    std::memset(row + kBlock + first, 0, size);
  }
  for (int k = 0; k < 3; ++k) {
    std::memset(b.photometric[k] + first, 0, size);
    std::memset(b.geometric[k] + first, 0, size);
  }
}

// A register holds whole texels, of kPoints points.
constexpr int kPoints = kPerRegister / kTexelSize;
static_assert(kTexelSize == 4);

// Load the texels at `place`, `place + kTexelSize` and so on, floats.
FloatRegister load_texels(const float* texels, const std::int64_t* places) {
#if defined(__AVX512F__)
  const auto at = [&](int i) { return _mm_loadu_ps(texels + places[kTexelSize * i]); };
  const __m512 two = _mm512_insertf32x4(_mm512_castps128_ps512(at(0)), at(1), 1);
  return _mm512_insertf32x4(_mm512_insertf32x4(two, at(2), 2), at(3), 3);
#elif defined(__AVX2__)
  const auto at = [&](int i) { return _mm_loadu_ps(texels + places[kTexelSize * i]); };
  return _mm256_insertf128_ps(_mm256_castps128_ps256(at(0)), at(1), 1);
#else
  FloatRegister values;
  std::memcpy(&values, texels + places[0], sizeof values);
  return values;
#endif
}

// Pattern that repeats the value K of each group of four lanes in the whole group.
template <int K>
struct Repeat {
  static constexpr int source(int lane) { return (lane & ~3) + K; }
};

// Pattern that replaces the last value of each group of four lanes by the first one of another
// register.
struct ReplaceLast {
  static constexpr int source(int lane) {
    return (lane & 3) == 3 ? (lane & ~3) + kPerRegister : lane;
  }
};

// Interpolate the texels between the four pixels around a point, for kPoints points. The results
// have intensity and gradients. In place of the depth, they have the lowest intensity of the four
// pixels.
[[gnu::always_inline]] inline FloatRegister interpolated(const float* texels,
                                                         const std::int64_t* places,
                                                         std::int64_t below, FloatRegister du,
                                                         FloatRegister dv) {
  const FloatRegister a = load_texels(texels, places);
  const FloatRegister b = load_texels(texels + kTexelSize, places);
  const FloatRegister c = load_texels(texels + below, places);
  const FloatRegister d = load_texels(texels + below + kTexelSize, places);
  const FloatRegister upper = a + du * (b - a), lower = c + du * (d - c);
  const FloatRegister mixed = upper + dv * (lower - upper);
  return shuffle<ReplaceLast>(mixed, least(least(a, b), least(c, d)));
}

FloatRegister load_register(const float* p) {
  FloatRegister values;
  std::memcpy(&values, p, sizeof values);
  return values;
}

void store(FloatRegister values, float* p) { std::memcpy(p, &values, sizeof values); }

// The points of a register lie four places apart, so that a transpose of each group of four lanes
// brings the values of all points into order.
void sample(const Problem& p, Block& b) {
  const std::int64_t below = static_cast<std::int64_t>(kTexelSize) * p.width;
  for (int i = 0; i < kChunk; i += kPerRegister) {
    std::int64_t places[kPerRegister];
    for (int k = 0; k < kPerRegister; ++k)
      places[k] = static_cast<std::int64_t>(kTexelSize) * b.corner[i + k];
    const FloatRegister du = load_register(b.du + i), dv = load_register(b.dv + i);
    const auto at = [&](auto repeat, int k) {
      using Pattern = decltype(repeat);
      return interpolated(p.target, places + k, below, shuffle<Pattern>(du, du),
                          shuffle<Pattern>(dv, dv));
    };
    const FloatRegister t[4] = {at(Repeat<0>(), 0), at(Repeat<1>(), 1), at(Repeat<2>(), 2),
                                at(Repeat<3>(), 3)};
    const FloatRegister front = shuffle<Interleave<1, false>>(t[0], t[1]);
    const FloatRegister back = shuffle<Interleave<1, false>>(t[2], t[3]);
    const FloatRegister front_rest = shuffle<Interleave<1, true>>(t[0], t[1]);
    const FloatRegister back_rest = shuffle<Interleave<1, true>>(t[2], t[3]);
    const FloatRegister intensity = shuffle<Interleave<2, false>>(front, back);
    const FloatRegister darkest = shuffle<Interleave<2, true>>(front_rest, back_rest);
    store(darkest > 0 ? intensity : FloatRegister{}, b.intensity + i);
    store(shuffle<Interleave<2, true>>(front, back), b.gradient_u + i);
    store(shuffle<Interleave<2, false>>(front_rest, back_rest), b.gradient_v + i);
    for (int k = 0; k < kPerRegister; ++k)
      b.depth[i + k] = p.target[static_cast<std::int64_t>(kTexelSize) * b.nearest[i + k] + kDepth];
  }
}

float robust_weight(float square) { return (kDegrees + 1.0f) / (kDegrees + square); }

// Compute the photometric residuals r = I(project(p)) - gain * shade - bias and their Jacobians. A
// perturbation T_reference_camera exp(xi) moves a point by dp = skew(p) omega - v.
void weigh_photometric(const Problem& p, int first, Block& b) {
  const float inverse_sigma = 1.0f / p.intensity_sigma;
  const float* shades = b.point[kShade] + first;
#pragma GCC ivdep
  for (int i = 0; i < kChunk; ++i) {
    const float x = b.x[i], y = b.y[i], z = b.z[i], inverse = b.inverse_z[i], seen = b.depth[i];
    const bool hidden = (seen > 0) & (z > seen * (1.0f + p.occlusion));
    const float used = hidden ? 0.0f : b.visible[first + i];
    b.visible[first + i] = used;
    const float gx = b.gradient_u[i] * p.camera.fx * inverse;
    const float gy = b.gradient_v[i] * p.camera.fy * inverse;
    const float gz = -(gx * x + gy * y) * inverse;
    const float shade = shades[i];
    const float compared = (shade > 0) & (b.intensity[i] > 0) ? used : 0.0f;
    const float r = b.intensity[i] - p.gain * shade - p.bias;
    const float normalized = r * inverse_sigma, square = normalized * normalized;
    const float weight = robust_weight(square);
    const float s = compared * std::sqrt(weight) * inverse_sigma;
    b.rows[0][first + i] = s * (gy * z - gz * y);
    b.rows[1][first + i] = s * (gz * x - gx * z);
    b.rows[2][first + i] = s * (gx * y - gy * x);
    b.rows[3][first + i] = -s * gx;
    b.rows[4][first + i] = -s * gy;
    b.rows[5][first + i] = -s * gz;
    b.rows[6][first + i] = -s * shade;
    b.rows[7][first + i] = -s;
    b.rows[8][first + i] = s * r;
    b.photometric[0][first + i] = compared;
    b.photometric[1][first + i] = square < kInlierSigma * kInlierSigma ? compared : 0.0f;
    b.photometric[2][first + i] = compared * weight * square;
  }
}

// Compute the geometric residuals r = n . (p - q) and their Jacobians, with n = R n_reference. The
// point q is the measured surface of the target image at the nearest pixel.
void weigh_geometric(const Problem& p, int first, Block& b) {
  const float* T = p.T_camera_reference;
  const float ifx = 1.0f / p.camera.fx, ify = 1.0f / p.camera.fy;
  const float *normals_x = b.point[kNormalX] + first, *normals_y = b.point[kNormalY] + first,
              *normals_z = b.point[kNormalZ] + first;
#pragma GCC ivdep
  for (int i = 0; i < kChunk; ++i) {
    const float mx = normals_x[i], my = normals_y[i], mz = normals_z[i];
    const float nx = T[0] * mx + T[1] * my + T[2] * mz;
    const float ny = T[4] * mx + T[5] * my + T[6] * mz;
    const float nz = T[8] * mx + T[9] * my + T[10] * mz;
    const float z = b.depth[i];
    const float qx = (b.column[i] - p.camera.cx) * ifx * z;
    const float qy = (b.row[i] - p.camera.cy) * ify * z;
    const float r = nx * (b.x[i] - qx) + ny * (b.y[i] - qy) + nz * (b.z[i] - z);
    const bool has_normal = nx * nx + ny * ny + nz * nz > 0.5f;
    const bool paired = (z > 0) & has_normal & (std::fabs(b.z[i] - z) < p.gate * b.z[i]);
    const float used = paired ? b.visible[first + i] : 0.0f;
    const float beyond = b.z[i] - p.noise.nearest;
    const float sigma = p.depth_noise_scale * (p.noise.floor + p.noise.growth * beyond * beyond);
    const float inverse_sigma = 1.0f / sigma;
    const float normalized = r * inverse_sigma, square = normalized * normalized;
    const float weight = robust_weight(square);
    const float s = used * std::sqrt(weight) * inverse_sigma;
    const int j = kBlock + first + i;
    b.rows[0][j] = s * (ny * z - nz * qy);
    b.rows[1][j] = s * (nz * qx - nx * z);
    b.rows[2][j] = s * (nx * qy - ny * qx);
    b.rows[3][j] = -s * nx;
    b.rows[4][j] = -s * ny;
    b.rows[5][j] = -s * nz;
    b.rows[8][j] = s * r;
    b.geometric[0][first + i] = used;
    b.geometric[1][first + i] = square < kInlierSigma * kInlierSigma ? used : 0.0f;
    b.geometric[2][first + i] = used * weight * square;
  }
}

// Return the sum of n products a b. Sixteen partial sums are added pairwise, in an order that does
// not depend on the machine's vector width.
double dot(const float* a, const float* b, int n) {
  Floats lanes(0.0f);
  for (int i = 0; i < n; i += kLanes) lanes = lanes + Floats::load(a + i) * Floats::load(b + i);
  return sum(lanes);
}

double sum(const float* a) {
  Floats lanes(0.0f);
  for (int i = 0; i < kBlock; i += kLanes) lanes = lanes + Floats::load(a + i);
  return sum(lanes);
}

// Number of products with one row that are summed at once: as many as the registers hold.
constexpr int kColumns = kRegisters == 1 ? 9 : 5;

// Add the products of the row R with the columns C to C + N - 1 to the equations. A load of the row
// then serves N products. Geometric residuals do not depend on gain and bias.
template <int R, int C, int N>
[[gnu::always_inline]] inline void accumulate_columns(const Block& b, Equations& e) {
  Floats lanes[N];
#pragma GCC unroll 9
  for (int k = 0; k < N; ++k) lanes[k] = Floats(0.0f);
  for (int i = 0; i < kBlock; i += kLanes) {
    const Floats row = Floats::load(b.rows[R] + i);
#pragma GCC unroll 9
    for (int k = 0; k < N; ++k) lanes[k] = lanes[k] + row * Floats::load(b.rows[C + k] + i);
  }
  if constexpr (R < 6) {
    for (int i = kBlock; i < 2 * kBlock; i += kLanes) {
      const Floats row = Floats::load(b.rows[R] + i);
#pragma GCC unroll 9
      for (int k = 0; k < N; ++k)
        if (C + k < 6 || C + k == kUnknowns)
          lanes[k] = lanes[k] + row * Floats::load(b.rows[C + k] + i);
    }
  }
#pragma GCC unroll 9
  for (int k = 0; k < N; ++k) {
    double& total = C + k == kUnknowns ? e.gradient[R] : e.hessian[R * kUnknowns + C + k];
    total += sum(lanes[k]);
  }
}

template <int R, int C>
[[gnu::always_inline]] inline void accumulate_rows(const Block& b, Equations& e) {
  if constexpr (R < kUnknowns && C <= kUnknowns) {
    constexpr int kLeft = kUnknowns + 1 - C, kCount = kLeft < kColumns ? kLeft : kColumns;
    accumulate_columns<R, C, kCount>(b, e);
    accumulate_rows<R, C + kCount>(b, e);
  } else if constexpr (R + 1 < kUnknowns) {
    accumulate_rows<R + 1, R + 1>(b, e);
  }
}

void accumulate(const Block& b, Equations& e) {
  accumulate_rows<0, 0>(b, e);
  e.visible += sum(b.visible);
  e.photometric_count += sum(b.photometric[0]);
  e.photometric_inliers += sum(b.photometric[1]);
  e.photometric_square += sum(b.photometric[2]);
  e.geometric_count += sum(b.geometric[0]);
  e.geometric_inliers += sum(b.geometric[1]);
  e.geometric_square += sum(b.geometric[2]);
}

// Add the gradients of the block that starts at point `first` to the cells of its strips.
void add_to_cells(const Problem& p, const Block& b, std::int64_t first, const std::uint8_t* cells,
                  double* sums) {
  for (int strip = 0; strip < kBlock && first + strip < p.count; strip += kStrip) {
    const std::int64_t last = p.count - 1, middle = first + strip + kStrip / 2;
    double* photometric = sums + 2 * kUnknowns * cells[middle < last ? middle : last];
    double* geometric = photometric + kUnknowns;
    for (int k = 0; k < kUnknowns; ++k) {
      const float *row = b.rows[k] + strip, *residual = b.rows[kUnknowns] + strip;
      photometric[k] += dot(row, residual, kStrip);
      if (k < 6) geometric[k] += dot(row + kBlock, residual + kBlock, kStrip);
    }
  }
}

Equations normal_equations(const Problem& problem, const std::uint8_t* cells, double* sums) {
  Equations e{};
  Block block;
  for (std::int64_t first = 0; first < problem.count; first += kBlock) {
    load(problem, first, block);
    for (int chunk = 0; chunk < kBlock; chunk += kChunk) {
      project(problem, chunk, block);
      if (!shows_points(chunk, block)) {
        clear(chunk, block);
        continue;
      }
      sample(problem, block);
      weigh_photometric(problem, chunk, block);
      weigh_geometric(problem, chunk, block);
    }
    accumulate(block, e);
    if (cells) add_to_cells(problem, block, first, cells, sums);
  }
  for (int r = 0; r < kUnknowns; ++r)
    for (int c = 0; c < r; ++c) e.hessian[r * kUnknowns + c] = e.hessian[c * kUnknowns + r];
  return e;
}

}  // namespace

const Kernels& LDO_ISA() {
  static const Kernels kernels{halve, halve_gray, pack, normals, points, normal_equations};
  return kernels;
}

}  // namespace ldo::align
