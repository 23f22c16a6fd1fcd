import numpy as np

from ldo_service.evaluation.iteration import Iteration, bench_camera


def test_gaussians_out_of_view_leave_images_bitwise_equal() -> None:
    camera = bench_camera(96, 64)
    alone, with_others = Iteration(3_000, camera), Iteration(3_000, camera, elsewhere=7_000)
    assert len(with_others.gaussians) == 10_000
    assert alone.forward().tobytes() == with_others.forward().tobytes()
    assert alone.forward()[4].mean() > 0.5


def test_descent_steps_change_the_gaussians() -> None:
    iteration = Iteration(500, bench_camera(64, 48))
    before = iteration.gaussians.rows.copy()
    for step in iteration.steps().values():
        step()
    moved = np.any(iteration.gaussians.rows != before, axis=1)
    assert moved.mean() > 0.2
