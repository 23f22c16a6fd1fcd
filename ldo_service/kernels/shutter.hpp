// Compensation of the camera's motion during a frame. Images are dense and row-major. A black pixel
// and a depth of 0 are missing. Pixel centers are at integer coordinates.
#pragma once
#include <cstdint>

namespace ldo {

constexpr int kCellPx = 8;  // Side of a cell of the grid on which the image motion is computed.
constexpr int kMotionPlanes = 3;  // Along u, along v, change of depth.

struct MovingCamera {
  int width, height;
  float fx, fy, cx, cy;
  float velocity[6];  // Rotation in rad/s, then translation in m/s, in the camera frame.

  int columns() const { return (width + kCellPx - 1) / kCellPx; }
  int rows() const { return (height + kCellPx - 1) / kCellPx; }
};

struct RowTimes {
  float readout_s, depth_readout_s, depth_delay_s;
};

struct Frame {
  const std::uint8_t* image;  // [height, width, channels]
  const float* depth;         // [height, width] meters.
};

struct WarpedFrame {
  std::uint8_t* image;
  float* depth;
};

// image_motion fills `motion` [3, rows, columns] with the motion of the surface at the centers of
// the cells: along u and v in pixels per second, and the relative change of its depth per second.
//
// warp moves an image of 1 or 3 channels and its depth to the middle of the frame.
#define LDO_DECLARE(isa)                                                                     \
  namespace isa {                                                                            \
  void image_motion(const float* depth, const MovingCamera& camera, float* motion);          \
  void warp(const Frame& frame, int channels, const MovingCamera& camera, const RowTimes& t, \
            const WarpedFrame& out);                                                         \
  }
LDO_DECLARE(baseline)
LDO_DECLARE(avx2)
LDO_DECLARE(avx512)
#undef LDO_DECLARE

}  // namespace ldo
