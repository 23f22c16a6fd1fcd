// Surfaces and foregrounds, compiled once per instruction set (macro LDO_ISA).
#include "foreground.hpp"

#include "box_foreground.hpp"
#include "smoothness.hpp"

namespace ldo::LDO_ISA {

std::vector<int64_t> surfaces(const DepthImage& image, const Pinhole& camera,
                              const SurfaceRule& rule, int32_t* labels) {
  const Components pieces(Smoothness(image, camera, rule).pixels());
  std::vector<int64_t> sizes(pieces.count() + 1, 0);
  for (int y = 0; y < image.height; ++y) {
    int32_t* row = labels + static_cast<int64_t>(y) * image.width;
    int end = 0;
    pieces.each_run(y, [&](const Components::Run& run) {
      sizes[0] += run.begin - end;
      sizes[run.part] += run.end - run.begin;
      std::fill(row + end, row + run.begin, 0);
      std::fill(row + run.begin, row + run.end, run.part);
      end = run.end;
    });
    sizes[0] += image.width - end;
    std::fill(row + end, row + image.width, 0);
  }
  return sizes;
}

bool foreground(const DepthImage& image, double focal_px, const SurfaceLabels& found,
                const Window& window, const ForegroundRule& rule, uint8_t* mask) {
  return BoxForeground(image, focal_px, found, window, rule).write(mask);
}

}  // namespace ldo::LDO_ISA
