import asyncio
import os
import sys
from concurrent.futures import CancelledError, ThreadPoolExecutor
from threading import Event, get_native_id

import pytest

from ldo_service.transport.worker import Worker


async def test_jobs_run_in_order_and_hand_back_their_results() -> None:
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
async def test_what_a_job_raises_comes_back(raised: type, expected: type) -> None:
    def job() -> None:
        raise raised

    worker = Worker("test")
    with pytest.raises(expected):
        await asyncio.wait_for(worker.run(job), 60)
    assert await worker.run(int) == 0  # the thread goes on
    worker.close()


def test_after_close_what_was_submitted_still_runs_and_the_rest_is_cancelled() -> None:
    worker, go = Worker("test"), Event()
    first, second = worker.submit(go.wait, 10), worker.submit(int)
    worker.close()
    worker.close()
    late = worker.submit(int)
    assert late.cancelled()
    go.set()
    assert first.result(5)
    assert second.result(5) == 0
    with pytest.raises(CancelledError):
        late.result(5)


def test_one_that_is_at_work_when_all_is_over_is_named() -> None:
    busy, idle, go = Worker("busy"), Worker("idle"), Event()
    busy.submit(go.wait, 60)
    assert "busy" not in Worker.busy_workers(0.0), "it is not closed"
    for worker in (busy, idle):
        worker.close()
    idle.join(10)
    left = Worker.busy_workers(0.01)
    assert "busy" in left
    assert "idle" not in left
    go.set()
    busy.join(10)
    assert "busy" not in Worker.busy_workers(0.01)


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux lets a thread be nice by itself")
async def test_a_worker_steps_back_alone_and_so_do_the_threads_it_starts() -> None:
    def nice() -> int:
        return os.getpriority(os.PRIO_PROCESS, get_native_id())

    def nice_of_another() -> int:
        with ThreadPoolExecutor(1) as pool:
            return pool.submit(nice).result()

    here, prompt, patient = nice(), Worker("prompt"), Worker("patient", nice=3)
    assert await prompt.run(nice) == here
    assert await patient.run(nice) == await patient.run(nice_of_another) == min(19, here + 3)
    assert nice() == here
    prompt.close()
    patient.close()


async def test_a_worker_that_may_not_step_back_works(
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
