import numpy as np
import pytest

from tests.kernels.gpu.agreement import check, peak
from tests.kernels.gpu.scenes import NAMES, SCENES, SEAM, host, of_cpu, of_kernel, rendered
from tests.reference.render import render_reference


@pytest.mark.parametrize("name", SCENES)
def test_planes_equal_those_of_the_cpu(name: str) -> None:
    _, wanted = of_cpu(SCENES[name])
    got = host(of_kernel(name).planes)
    assert np.isfinite(got).all()
    for k in range(5):
        check("planes to C++", peak(got[k], wanted[k]), f"{name}, plane {k}")


@pytest.mark.parametrize("name", [name for name in NAMES if name != "dark"])
def test_planes_equal_the_reference(name: str) -> None:
    """The reference does not stop early, so the limit is wider for scenes with dark pixels."""
    scene, got = SCENES[name], host(of_kernel(name).planes)
    shown = render_reference(
        scene.drawable_rows(), scene.camera, scene.T_rounded, binning=scene.binning
    )
    wanted = np.stack([*np.moveaxis(shown.color, -1, 0), shown.weighted_depth_m, shown.opacity])
    is_bright = wanted[4].max() < 1 - 2e-4
    for k in range(5):
        error = peak(got[k], wanted[k])
        if is_bright:
            check("planes to reference", error, f"{name}, plane {k}")
        assert error < 2e-4


def test_blocks_stop_where_the_cpu_stops() -> None:
    dark = of_kernel("dark")
    assert (host(dark.ends) < len(host(dark.lists.listed))).sum() >= 4
    seam = rendered(SEAM)
    _, wanted = of_cpu(SEAM)
    ends = host(seam.ends)
    assert 256 < ends.min() < len(host(seam.lists.listed))
    for k in range(5):
        check("planes to C++", peak(host(seam.planes)[k], wanted[k]), f"batch seam, plane {k}")
