"""Execution of jobs on a Ray cluster: one task for each recording."""

import os
import socket
from collections.abc import Generator, Iterable, Iterator
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType
from typing import Any

from ldo_service.errors import ConfigError, DataError, install_command

from .job import BatchJob, Outcome, failed
from .results import ResultFolder
from .work import process

RETRIES = 3  # Retries of a recording whose worker or host was lost.
CONNECT_S = 10.0  # Time limit of a connection to the cluster.
LOOPBACK = ("127.0.0.1", "localhost")
GB = 10**9


@dataclass(frozen=True, slots=True)
class RayNeeds:
    """Resources that Ray reserves for each recording."""

    cpus: int  # CPU cores.
    memory_gb: float  # Memory of the host, GB.
    gpus: float  # Graphics processors; a fraction shares one.


@dataclass(frozen=True, slots=True)
class RayExecutor:
    """Executor on a Ray cluster.

    Ray starts a task on a host where the needed resources are free. If the process or the host of
    the task is lost, Ray starts the task again on another host. A worker process ends after each
    recording.

    Attributes:
        address: Address of the cluster, such as `auto` or HOST:6379.
        needs: Resources for each recording.
        workers: Maximum number of recordings at the same time; None for as many as fit.

    Raises:
        ConfigError: Ray is not installed.
    """

    address: str
    needs: RayNeeds
    workers: int | None = None

    def __post_init__(self) -> None:
        _ray(self.address)

    def outcomes(self, jobs: Iterable[BatchJob]) -> Generator[Outcome, None, None]:
        """Yield the outcome of each job; see `Executor.outcomes`.

        Raises:
            ConfigError: The cluster cannot be reached, or no host has the resources that a
                recording needs.
        """
        ray = _ray(self.address)
        _connect(ray, self.address)
        try:
            self._require_host(ray)
            yield from self._outcomes(ray, iter(jobs))
        finally:
            ray.shutdown()  # Ends the tasks that are still running.

    def _outcomes(self, ray: ModuleType, waiting: Iterator[BatchJob]) -> Iterator[Outcome]:
        task = ray.remote(
            num_cpus=self.needs.cpus,
            num_gpus=self.needs.gpus,
            memory=int(self.needs.memory_gb * GB),
            max_retries=RETRIES,
            max_calls=1,
            scheduling_strategy="SPREAD",
        )(process)
        running: dict[Any, BatchJob] = {}
        while True:
            for job in waiting:
                running[task.remote(job)] = job
                if self.workers and len(running) >= self.workers:
                    break
            if not running:
                return
            done, _ = ray.wait(list(running), num_returns=1)
            for reference in done:
                job = running.pop(reference)
                yield _outcome(ray, reference, job)

    def _require_host(self, ray: ModuleType) -> None:
        """Check that at least one host has the resources of a recording.

        Ray itself would wait for such a host without end.
        """
        wanted = {
            "CPU": float(self.needs.cpus),
            "GPU": self.needs.gpus,
            "memory": self.needs.memory_gb * GB,
        }
        hosts = [node["Resources"] for node in ray.nodes() if node["Alive"]]
        if any(all(host.get(name, 0) >= value for name, value in wanted.items()) for host in hosts):
            return
        largest = {name: max((host.get(name, 0) for host in hosts), default=0) for name in wanted}
        raise ConfigError(
            f"no host of the Ray cluster {self.address} has {self.needs.cpus} CPUs, "
            f"{self.needs.memory_gb:g} GB of memory and {self.needs.gpus:g} GPUs, which a "
            f"recording needs. The largest values on any host are {largest['CPU']:g} CPUs, "
            f"{largest['memory'] / GB:.1f} GB and {largest['GPU']:g} GPUs. Lower --threads, "
            "--memory-gb or --gpus."
        )


def _outcome(ray: ModuleType, reference: Any, job: BatchJob) -> Outcome:
    try:
        outcome = ray.get(reference)
    except ray.exceptions.RayError as error:
        what = str(error).strip().splitlines()[0]
        return failed(job, f"its worker was lost {1 + RETRIES} times, the last time by: {what}")
    return _visible(outcome, job) if outcome.has_results else outcome


def _visible(outcome: Outcome, job: BatchJob) -> Outcome:
    """Return the outcome, or a failure if this host cannot read the results of the worker."""
    try:
        found = ResultFolder.of(job).finished()
    except DataError as error:
        return failed(job, str(error))
    if found is not None:
        return outcome
    host = outcome.costs.host if outcome.costs else "its host"
    return failed(
        job,
        f"the results that {host} wrote are not in {job.out} on this host. With --cluster, use a "
        "bucket or a folder that all hosts share.",
    )


def _ray(address: str) -> ModuleType:
    """Import Ray, which reads its variables of the environment when it is imported."""
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    if address.partition(":")[0] in LOOPBACK:
        # Ray otherwise replaces a loopback address by that of a network interface, where a
        # cluster on the loopback interface does not answer.
        os.environ.setdefault("RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER", "0")
    try:
        ray = import_module("ray")
        import_module("ray.exceptions")
    except ImportError as error:
        raise ConfigError(
            f"--cluster needs the extra `cluster` ({error}). Install it by "
            f"{install_command('cluster')}."
        ) from error
    return ray


def _connect(ray: ModuleType, address: str) -> None:
    _require_open_port(address)
    # This variable silences a warning about tasks without GPUs.
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")
    try:
        ray.init(address=address, log_to_driver=False, logging_level="ERROR")
    except Exception as error:
        what = " ".join(str(error).split())
        raise ConfigError(
            f"the Ray cluster {address} cannot be used: {what[:400]}. Check that `ray status "
            f"--address {address}` shows it, and that all hosts have the same versions of Python "
            "and Ray."
        ) from error


def _require_open_port(address: str) -> None:
    """Check that something listens at HOST:PORT, because Ray itself would try for six minutes."""
    host, _, port = address.rpartition("/")[2].rpartition(":")
    if not (host and port.isdecimal()):
        return
    try:
        socket.create_connection((host, int(port)), CONNECT_S).close()
    except OSError as error:
        raise ConfigError(
            f"the Ray cluster {address} does not answer: {error}. Check the address, which "
            "`ray start --head` prints, and that no firewall blocks the port."
        ) from error
