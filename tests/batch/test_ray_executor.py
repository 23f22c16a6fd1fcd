"""Batches on a Ray cluster of two nodes on this machine, with results in a bucket on loopback.

The tests need the extra `cluster` and the package `moto[server]`.
"""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from ldo_service.batch import RayExecutor, RayNeeds, process
from ldo_service.batch.batch import Batch
from ldo_service.batch.sources import measure
from ldo_service.errors import ConfigError
from tests.batch.slices import write_slice
from tests.ports import free_port

pytestmark = [
    pytest.mark.slow,
    pytest.mark.filterwarnings("ignore"),  # Warnings of Ray and moto about themselves.
]
NEEDS = RayNeeds(cpus=1, memory_gb=0.5, gpus=0)

# Ray reads this variable when it is imported. Its value 0 keeps Ray on the loopback interface.
os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
ray = pytest.importorskip("ray", reason="install the extra `cluster`")


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Yield the address of an empty bucket of a server of this process."""
    server_module = pytest.importorskip("moto.server", reason="pip install 'moto[server]'")
    s3fs = pytest.importorskip("s3fs", reason="install the extra `s3`")
    port = free_port()
    server = server_module.ThreadedMotoServer("127.0.0.1", port, verbose=False)
    server.start()
    variables = {
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
        "AWS_ACCESS_KEY_ID": "test",
        "AWS_SECRET_ACCESS_KEY": "test",
        "AWS_DEFAULT_REGION": "us-east-1",
    }
    for name, value in variables.items():
        monkeypatch.setenv(name, value)
    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir(f"batch-{port}")
    yield f"s3://batch-{port}/night"
    server.stop()


@pytest.fixture
def cluster(
    bucket: str,  # noqa: ARG001
    monkeypatch: pytest.MonkeyPatch,
) -> Iterator:
    """Yield a Ray cluster of two nodes with one CPU each, with the variables of the bucket."""
    # The machine of a test may be nearly full for other reasons.
    monkeypatch.setenv("RAY_memory_monitor_refresh_ms", "0")
    from ray.cluster_utils import Cluster

    local = {
        "num_cpus": 1,
        "memory": 2 * 10**9,
        "object_store_memory": 80 * 10**6,
        "node_ip_address": "127.0.0.1",
    }
    nodes = Cluster()
    _add_node(nodes, **local, include_dashboard=False)
    _add_node(nodes, **local)
    yield nodes
    nodes.shutdown()


def _add_node(nodes, **arguments) -> None:
    """Start a node; Ray gives up after 30 s, which is too short for a busy machine."""
    for _ in range(4):
        try:
            nodes.add_node(**arguments)
            return
        except Exception as error:
            problem = error
    pytest.fail(f"Ray does not start: {problem}")


@pytest.mark.parametrize("count", [4, 12])
def test_batch_on_two_nodes_survives_the_loss_of_one_and_equals_a_serial_run(
    count: int,
    bucket: str,
    cluster,
    batch: Callable[..., Batch],
    room_folder: Path,
    tmp_path: Path,
) -> None:
    sources = [
        str(write_slice(room_folder, tmp_path / f"recordings/part_{k}", k // 2, 8 + k % 2))
        for k in range(count)
    ]
    on_cluster, serial = batch(bucket), batch(tmp_path / "serial")
    outcomes = []
    for outcome in on_cluster.outcomes(
        sources, RayExecutor(cluster.address, NEEDS), lambda _: None
    ):
        outcomes.append(outcome)
        if len(outcomes) == count // 4:  # Both nodes are busy with other recordings.
            cluster.remove_node(cluster.worker_nodes.copy().pop(), allow_graceful=False)
    # The lost node has one CPU. If it has published its result before, the repetition keeps it.
    statuses = [outcome.status for outcome in outcomes]
    assert statuses.count("done") >= count - 1
    assert statuses.count("done") + statuses.count("kept") == len(statuses) == count
    found = {outcome.source: outcome.digest for outcome in outcomes}
    assert found == {source: process(serial.job(measure(source))).digest for source in sources}
    assert len(set(found.values())) == count

    again = on_cluster.outcomes(sources, RayExecutor(cluster.address, NEEDS), lambda _: None)
    assert {
        outcome.source: outcome.digest for outcome in again if outcome.status == "kept"
    } == found


def test_needs_that_no_node_has_are_refused_instead_of_waiting(
    cluster, batch: Callable[..., Batch], room_folder: Path
) -> None:
    executor = RayExecutor(cluster.address, RayNeeds(cpus=64, memory_gb=0.5, gpus=0))
    with pytest.raises(
        ConfigError, match=r"no host of .* has 64 CPUs.*The largest values .* 1 CPUs"
    ):
        list(batch().outcomes([str(room_folder)], executor, lambda _: None))


def test_absent_cluster_is_one_paragraph(batch: Callable[..., Batch], room_folder: Path) -> None:
    executor = RayExecutor(f"127.0.0.1:{free_port()}", NEEDS)
    with pytest.raises(ConfigError, match=r"Ray cluster 127.0.0.1:.* does not answer"):
        list(batch().outcomes([str(room_folder)], executor, lambda _: None))
