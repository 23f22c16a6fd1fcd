// Direct RGB-D alignment: pyramid halving, normals, reference points and normal equations.
// Images are dense and row-major; pixel centres are at integer coordinates; 0 depth is missing.
#pragma once
#include <cstdint>

namespace ldo::align {

struct Pinhole {
  float fx, fy, cx, cy;
};

// A target image holds four floats per pixel, so that one load brings all that a sample needs.
// An intensity of 0 says no more than a depth of 0: the pixel was clipped, black or white.
enum Texel { kIntensity, kGradientU, kGradientV, kDepth, kTexelSize };

// Reference points are stored as rows of N floats: coordinates, intensity, normal (0 0 0: none).
enum PointRow { kX, kY, kZ, kShade, kNormalX, kNormalY, kNormalZ, kPointRows };

// Axial noise of a structured-light sensor: sigma(z) = floor + growth (z - nearest)^2, metres.
struct DepthNoise {
  float floor, growth, nearest;
};

struct Problem {
  const float* points;  // [kPointRows, count], reference frame
  std::int64_t count;
  const float* target;  // [height, width, kTexelSize]
  int width, height;
  Pinhole camera;
  float T_camera_reference[12];  // rows of [R | t]
  float gain, bias;              // target intensity = gain * reference + bias
  float intensity_sigma;         // grey levels
  float depth_noise_scale;       // times DepthNoise
  DepthNoise noise;
  float gate;       // largest depth difference of a pair, relative to depth
  float occlusion;  // a point this much behind the target's surface is hidden, relative to depth
};

constexpr int kUnknowns = 8;  // rotation, translation, gain, bias

struct Equations {
  double hessian[kUnknowns * kUnknowns];  // sum of w J^T J
  double gradient[kUnknowns];             // sum of w J^T r
  double visible;                         // points inside the image and not hidden
  double photometric_count, photometric_inliers, photometric_square;  // square: sum w (r/sigma)^2
  double geometric_count, geometric_inliers, geometric_square;
};

// The entry points, compiled once per instruction set.
struct Kernels {
  // Mean of those of each 2x2 block that are within `tolerance` (relative) of the lowest, 0 of
  // fewer than `least`; zeros are not measured.
  void (*halve)(const float* values, int width, int height, float tolerance, int least, float* out);
  // Texels of an image and its depth, which is dropped beyond `max_depth`; gradients are central
  // differences, 0 on the border and beside clipped pixels.
  void (*pack)(const float* image, const float* depth, int width, int height, float max_depth,
               float* out);
  // Normals [height, width, 3] towards the camera from differences over `radius` pixels.
  void (*normals)(const float* depth, int width, int height, const Pinhole& camera, int radius,
                  float* out);
  // Fills `points` [kPointRows, capacity] with the pixels that have depth; returns how many.
  std::int64_t (*points)(const float* texels, const float* normals, int width, int height,
                         const Pinhole& camera, std::int64_t capacity, float* points);
  Equations (*normal_equations)(const Problem& problem);
};

const Kernels& baseline();
const Kernels& avx2();
const Kernels& avx512();

}  // namespace ldo::align
