import asyncio
import os
import sys
from concurrent.futures import CancelledError, ThreadPoolExecutor
from threading import Event, get_native_id

import pytest

from ldo_service.transport.worker import Worker


async def test_jobs_run_in_order_and_return_their_results() -> None:
    worker, done = Worker("test"), []

    def job(value: int) -> int:
        done.append(value)
        return value * value

    assert await asyncio.gather(*(worker.run(job, value) for value in range(20))) == [
        value * value for value in range(20)
    ]
    assert done == list(range(20))
    worker.close()


@pytest.mark.parametrize(
    ("raised", "expected"),
    [(KeyError, KeyError), (StopIteration, RuntimeError), (SystemExit, RuntimeError)],
)
async def test_exception_of_a_job_is_raised_by_run(raised: type, expected: type) -> None:
    def job() -> None:
        raise raised

    worker = Worker("test")
    with pytest.raises(expected):
        await asyncio.wait_for(worker.run(job), 60)
    assert await worker.run(int) == 0  # The thread continues.
    worker.close()


def test_close_finishes_submitted_jobs_and_cancels_later_ones() -> None:
    worker, release = Worker("test"), Event()
    first, second = worker.submit(release.wait, 10), worker.submit(int)
    worker.close()
    worker.close()
    late = worker.submit(int)
    assert late.cancelled()
    release.set()
    assert first.result(5)
    assert second.result(5) == 0
    with pytest.raises(CancelledError):
        late.result(5)


def test_busy_workers_lists_closed_workers_that_still_run() -> None:
    busy, idle, release = Worker("busy"), Worker("idle"), Event()
    busy.submit(release.wait, 60)
    assert "busy" not in Worker.busy_workers(0.0), "the worker is not closed"
    for worker in (busy, idle):
        worker.close()
    idle.join(10)
    running = Worker.busy_workers(0.01)
    assert "busy" in running
    assert "idle" not in running
    release.set()
    busy.join(10)
    assert "busy" not in Worker.busy_workers(0.01)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets a thread be nice by itself")
async def test_nice_worker_lowers_priority_of_its_own_threads_only() -> None:
    def nice() -> int:
        return os.getpriority(os.PRIO_PROCESS, get_native_id())

    def nice_of_another() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(nice).result()

    own, normal, nice_worker = nice(), Worker("normal"), Worker("nice_worker", nice=3)
    assert await normal.run(nice) == own
    assert await nice_worker.run(nice) == await nice_worker.run(nice_of_another) == min(19, own + 3)
    assert nice() == own
    normal.close()
    nice_worker.close()


async def test_worker_without_permission_for_nice_still_works(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def forbidden(*_: int) -> None:
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr("sys.platform", "linux")
    monkeypatch.setattr("os.setpriority", forbidden)
    worker = Worker("mapper", nice=3)
    assert await worker.run(int) == 0
    assert "mapper: cannot lower the thread priority (Operation not permitted)" in caplog.text
    worker.close()
