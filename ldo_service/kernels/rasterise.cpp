// Compiled once per instruction set, LDO_ISA.
#include "rasterise.hpp"

#include "blend.hpp"

namespace ldo::LDO_ISA {

void rasterise(const float* rows, int64_t n, const View& view, int threads, Images out) {
  const VisibleSplats visible = project(rows, n, view, threads);
  const TileLists lists = list_by_tile(visible, view, threads);
  parallel_for(static_cast<int64_t>(lists.columns) * lists.rows, threads, [&](int64_t t) {
    Tile tile(static_cast<int>(t % lists.columns), static_cast<int>(t / lists.columns), view);
    const uint32_t start = lists.start[t];
    tile.blend(visible.splats.data(), lists.splats.data() + start, lists.start[t + 1] - start);
    tile.store(out);
  });
}

}  // namespace ldo::LDO_ISA
