// Direct RGB-D alignment: pyramid halving, normals, reference points and normal equations. Images
// are dense and row-major. Pixel centers are at integer coordinates. A depth of 0 is missing.
#pragma once
#include <cstdint>

namespace ldo::align {

struct Pinhole {
  float fx, fy, cx, cy;
};

// A target image holds four floats per pixel, so that one load fetches all values of a sample. An
// intensity or a depth of 0 is missing. An intensity is missing if the pixel was clipped, black or
// white.
enum Texel { kIntensity, kGradientU, kGradientV, kDepth, kTexelSize };

// Reference points are stored as rows of N floats: coordinates, intensity and normal. A missing
// normal is 0 0 0.
enum PointRow { kX, kY, kZ, kShade, kNormalX, kNormalY, kNormalZ, kPointRows };

// Axial noise of a structured-light sensor: sigma(z) = floor + growth (z - nearest)^2, in meters.
struct DepthNoise {
  float floor, growth, nearest;
};

struct Problem {
  const float* points;  // [kPointRows, count], reference frame.
  std::int64_t count;
  const float* target;  // [height, width, kTexelSize].
  int width, height;
  Pinhole camera;
  float T_camera_reference[12];  // Rows of [R | t].
  float gain, bias;              // Target intensity = gain * reference + bias.
  float intensity_sigma;         // Gray levels.
  float depth_noise_scale;       // Factor on DepthNoise.
  DepthNoise noise;
  float gate;  // Maximum depth difference of a point and the target, relative to the depth.
  // Distance behind the target's surface beyond which a point is hidden, relative to the depth.
  float occlusion;
};

constexpr int kUnknowns = 8;  // Rotation, translation, gain, bias.
constexpr int kStrip = 16;    // Consecutive points that are added to the same cell.
constexpr int kCells = 64;    // Maximum number of cells.

struct Equations {
  double hessian[kUnknowns * kUnknowns];  // Sum of w J^T J.
  double gradient[kUnknowns];             // Sum of w J^T r.
  double visible;                         // Number of points inside the image and not hidden.
  // Squares are sums of w (r/sigma)^2.
  double photometric_count, photometric_inliers, photometric_square;
  double geometric_count, geometric_inliers, geometric_square;
};

// Entry points, compiled once per instruction set.
struct Kernels {
  // Average each 2x2 block over the values of at most (1 + `tolerance`) times its lowest value.
  // Zeros are missing values. The result is 0 for a block with fewer than `least` such values.
  void (*halve)(const float* values, int width, int height, float tolerance, int least, float* out);
  // Average 2x2 blocks of gray levels. Levels of at least `clipped` are missing values, as 0 is.
  void (*halve_gray)(const std::uint8_t* gray, int width, int height, int clipped, int least,
                     float* out);
  // Combine an image and its depth into texels. Depth beyond `max_depth` becomes 0. Gradients are
  // central differences, 0 on the border and next to clipped pixels.
  void (*pack)(const float* image, const float* depth, int width, int height, float max_depth,
               float* out);
  // Compute normals [height, width, 3] towards the camera from differences over `radius` pixels.
  void (*normals)(const float* depth, int width, int height, const Pinhole& camera, int radius,
                  float* out);
  // Fill `points` [kPointRows, capacity] with the pixels that have depth. Return their number.
  std::int64_t (*points)(const float* texels, const float* normals, int width, int height,
                         const Pinhole& camera, std::int64_t capacity, float* points);
  // Compute the equations of all points. If `cells` is not null, it has a cell number below kCells
  // for each point. The gradients of the photometric and of the geometric residuals of each strip
  // are then added to `sums` [kCells, 2, kUnknowns] at the cell of the strip's middle point.
  Equations (*normal_equations)(const Problem& problem, const std::uint8_t* cells, double* sums);
};

const Kernels& baseline();
const Kernels& avx2();
const Kernels& avx512();

}  // namespace ldo::align
