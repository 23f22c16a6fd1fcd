"""Label results for regions, and labellers that fail, hang or are missing."""

import asyncio
import logging
from collections.abc import Sequence
from pathlib import Path
from threading import Event

import numpy as np
import pytest

from ldo_service.actors.vlm_labeller import VlmLabeller, VlmLabellerConfig, require_labeller
from ldo_service.config import Config
from ldo_service.config.network_settings import VlmLabellerSettings
from ldo_service.detection.labellers import ScoredLabel
from ldo_service.detection.labellers.chat_completion import HttpConfig
from ldo_service.detection.labellers.http_endpoint import HttpClientConfig
from ldo_service.errors import ConfigError, EndpointError, ModelError, ReplayDiverged
from ldo_service.geometry import codecs
from ldo_service.runs.replayed import open_recording
from ldo_service.runtime import Out
from ldo_service.runtime.outlet import Outlet
from ldo_service.runtime.stage import Stage
from ldo_service.schemas import AddLabel, Image, LabelNames, LabelRequest, LabelResult, decode
from ldo_service.schemas.labels import MAX_ALTERNATIVES
from ldo_service.schemas.topics import LABEL_ADD, LABEL_NAMES, LABEL_REQUEST, LABEL_RESULT
from ldo_service.service.service import open_recorder
from ldo_service.storage.memory_store import MemoryStore
from ldo_service.transport.interface import MemoryTransport
from tests.detection.labellers.encoders import ColorPair, embeddings, plain_image, vocabulary
from tests.detection.labellers.server import hangs, replies_with, responds, serving
from tests.runtime.fake_actors import QUICK, eventually, running, send


def crop_message(color: np.ndarray) -> Image:
    """Return a crop [h, w, 3] uint8 RGB as JPEG."""
    height, width = color.shape[:2]
    data = memoryview(codecs.encode_jpeg(color))
    return Image(encoding="jpeg", width=width, height=height, data=data)


def request(region: int = 7, color: str = "red", **fields) -> LabelRequest:
    return LabelRequest(
        **{
            "stamp_ns": 1000 + region,
            "region": region,
            "keyframe": 3,
            "box_px": (1.0, 2.0, 30.0, 40.0),
            "crops": (crop_message(plain_image(color)),),
            **fields,
        }
    )


def only_result(messages) -> LabelResult:
    (message,) = messages
    assert isinstance(message, LabelResult)
    return message


def add_name(actor: VlmLabeller, name: str) -> LabelNames:
    (answer,) = actor.handle(AddLabel(stamp_ns=5, name=name))
    assert isinstance(answer, LabelNames)
    return answer


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A folder with a pair of encoders and a text encoder."""
    folder = tmp_path / "colors"
    folder.mkdir()
    ColorPair().image(folder / "model.onnx")
    ColorPair().text(folder / "text.onnx")
    vocabulary(folder / "bpe.txt.gz")
    return folder


@pytest.fixture
def names(tmp_path: Path) -> Path:
    path = tmp_path / "names.txt"
    path.write_text("red\ngreen\n")
    return path


class FakeLabeller:
    """Labeller that returns fixed labels, once its gate is open."""

    identity, names = "scripted 1", ("cup",)

    def __init__(self, scored_labels: list[ScoredLabel], gate: Event | None = None) -> None:
        self.scored_labels, self.gate = scored_labels, gate
        self.seen: list[int] = []

    def label(self, crops: Sequence[np.ndarray]) -> list[ScoredLabel]:
        self.seen.append(len(crops))
        if self.gate:
            assert self.gate.wait(60)
        return self.scored_labels

    def add(self, name: str) -> None:
        self.names = (*self.names, name)

    def metrics(self) -> dict[str, float]:
        return {"names": len(self.names)}


def test_spellings_of_one_name_are_saved_once(pair: Path, names: Path) -> None:
    actor = VlmLabeller(VlmLabellerConfig(model=str(pair), names=str(names)))
    for name in ("Blue", "blue", " BLUE ", "bLUE"):
        assert add_name(actor, name).error == ""
    assert actor.snapshot() == {"added": ("Blue",)}


def test_name_of_too_many_characters_is_rejected_although_most_are_spaces() -> None:
    with pytest.raises(ValueError, match="name has 101 characters"):
        AddLabel(stamp_ns=1, name="blue" + 97 * " ")


# --- answers --------------------------------------------------------------------------------------
def test_a_region_gets_its_name(pair: Path, names: Path) -> None:
    actor = VlmLabeller(VlmLabellerConfig(model=str(pair), names=str(names)))
    answer = only_result(actor.handle(request(region=12, color="green")))
    assert (answer.region, answer.keyframe, answer.stamp_ns) == (12, 3, 1012)
    assert answer.label == "green"
    assert 0.9 < answer.confidence <= 1
    assert answer.labeller.startswith("colors ")
    facts = actor.metrics()
    assert (facts["labellers"], facts["regions_named"], facts["names"]) == (1, 1, 2)


def test_result_lists_alternative_labels_up_to_the_maximum() -> None:
    scored_labels = [("cup", 0.5), ("vase", 0.3), ("bowl", 0.1)]
    answer = only_result(VlmLabeller(labeller=FakeLabeller(scored_labels)).handle(request()))
    assert (answer.label, answer.alternatives) == ("cup", (("vase", 0.3), ("bowl", 0.1)))
    many = [(f"name {k}", 0.01) for k in range(99)]
    assert (
        len(only_result(VlmLabeller(labeller=FakeLabeller(many)).handle(request())).alternatives)
        == MAX_ALTERNATIVES
    )


def test_without_labeller_requests_get_empty_results_at_once() -> None:
    actor = VlmLabeller()
    answer = only_result(actor.handle(request()))
    assert (answer.label, answer.confidence, answer.labeller) == ("", 0, "")
    assert (actor.metrics()["labellers"], actor.metrics()["labellers_missing"]) == (0, 0)
    assert "vlm_labeller.model" in add_name(actor, "teapot").error


def test_result_without_a_label_still_names_the_labeller() -> None:
    answer = only_result(VlmLabeller(labeller=FakeLabeller([])).handle(request()))
    assert (answer.label, answer.confidence, answer.labeller) == ("", 0, "scripted 1")


@pytest.mark.parametrize(
    "config",
    [
        {"model": "absent"},
        {"model": "garbage"},
        {"url": "nonsense"},
        {"url": "http://127.0.0.1:1/v1", "names": "absent.txt"},
    ],
)
def test_unusable_labeller_is_logged_once_and_gives_empty_results(
    tmp_path: Path, caplog, config: dict
) -> None:
    if config.get("model") == "garbage":
        (tmp_path / "model.onnx").write_text("garbage")
        (tmp_path / "embeddings.npz").write_text("garbage")
        config = {"model": str(tmp_path)}
    actor = VlmLabeller(VlmLabellerConfig(**config))
    for _ in range(3):
        assert only_result(actor.handle(request())).labeller == ""
    (record,) = caplog.records
    assert record.levelno == logging.ERROR
    assert actor.metrics()["labellers_missing"] == 1
    with pytest.raises(ConfigError):
        require_labeller(VlmLabellerConfig(**config))


def test_failures_are_counted_and_logged_once_until_recovery(caplog) -> None:
    class Failing(FakeLabeller):
        def label(self, crops: Sequence[np.ndarray]) -> list[ScoredLabel]:
            if len(self.seen) in (1, 2):
                self.seen.append(0)
                raise EndpointError("it is down.") if len(self.seen) == 2 else ModelError("NaN.")
            return super().label(crops)

    actor = VlmLabeller(labeller=Failing([("cup", 0.5)]))
    caplog.set_level(logging.INFO)
    answers = [only_result(actor.handle(request())) for _ in range(5)]
    assert [answer.label for answer in answers] == ["cup", "", "", "cup", "cup"]
    assert [bool(answer.labeller) for answer in answers] == [True, False, False, True, True]
    assert len(caplog.records) == 2
    assert actor.metrics()["labellings_failed"] == 2
    assert actor.metrics()["labeller_failing"] == 0


def test_undecodable_crop_leaves_its_region_unnamed() -> None:
    labeller = FakeLabeller([("cup", 0.5)])
    broken = Image(encoding="jpeg", width=9, height=9, data=memoryview(b"no jpeg"))
    answer = only_result(VlmLabeller(labeller=labeller).handle(request(crops=(broken,))))
    assert answer.label == ""
    assert labeller.seen == []


@pytest.mark.parametrize(
    ("behaves", "facts"),
    [
        (replies_with("cup", 0.75), {"regions_named": 1}),
        (
            replies_with("a kind of thing, I believe", 0.9),
            {"answers_refused": 1, "regions_unnamed": 1},
        ),
        (responds(500), {"labellings_failed": 1, "labeller_failing": 1}),
        (responds(200, b"nonsense"), {"labellings_failed": 1, "labeller_failing": 1}),
        (hangs, {"labellings_failed": 1, "labeller_failing": 1}),
    ],
    ids=["good", "nonsense", "500", "no json", "hangs"],
)
def test_only_a_valid_server_answer_labels_the_region(
    tmp_path: Path, behaves, facts: dict[str, float]
) -> None:
    (tmp_path / "names.txt").write_text("cup\nvase\n")
    timeout_s = 0.2 if behaves is hangs else 30.0
    endpoint = HttpClientConfig(timeout_s=timeout_s, patience_s=30.0, attempts=1, per_minute=1e9)
    with serving(behaves) as server:
        config = VlmLabellerConfig(
            url=server.url, names=str(tmp_path / "names.txt"), http=HttpConfig(endpoint=endpoint)
        )
        actor = VlmLabeller(config)
        answer = only_result(actor.handle(request()))
    is_good = "regions_named" in facts
    assert (answer.label, answer.confidence) == (
        ("cup", pytest.approx(0.75)) if is_good else ("", 0)
    )
    assert facts.items() <= actor.metrics().items()


def test_model_and_server_together_are_refused() -> None:
    with pytest.raises(ConfigError, match="choose one"):
        VlmLabellerConfig(model="clip", url="http://127.0.0.1:1/v1")


# --- added names ----------------------------------------------------------------------------------
def test_added_name_is_recognized_and_survives_a_restart(pair: Path, names: Path) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    first, unchanged = VlmLabeller(config), VlmLabeller(config)
    assert add_name(first, "Blue").names == ("red", "green", "blue")
    state = first.snapshot()
    assert first.snapshot() is state, "an unchanged state is not written again"
    restored = VlmLabeller(config)
    restored.restore(state)
    for actor in (first, restored):
        assert only_result(actor.handle(request(color="blue"))).label == "blue"
    assert only_result(unchanged.handle(request(color="blue"))).confidence < 0.6
    assert restored.metrics()["names_added"] == 1


def test_name_without_text_encoder_is_refused_and_kept_in_restored_state(
    tmp_path: Path, pair: Path, caplog
) -> None:
    ColorPair().image(tmp_path / "model.onnx")
    embeddings(tmp_path / "embeddings.npz")
    cached = VlmLabeller(VlmLabellerConfig(model=str(tmp_path)))
    answer = add_name(cached, "teapot")
    assert "--text (text encoder) and --vocabulary" in answer.error
    assert answer.names == ("red", "green", "blue")
    assert cached.metrics()["names_refused"] == 1
    cached.restore({"added": ["teapot"]})
    assert "saved name 'teapot' not added" in caplog.text
    able = VlmLabeller(VlmLabellerConfig(model=str(pair)))
    able.restore(cached.snapshot())
    assert "teapot" in add_name(able, "samovar").names


# --- in a stage -----------------------------------------------------------------------------------
def stage(transport: MemoryTransport, labeller: FakeLabeller, **fields) -> Stage:
    return Stage(lambda: VlmLabeller(labeller=labeller), transport, config=QUICK, **fields)


def mapper_outlet(transport: MemoryTransport) -> Outlet:
    """Return an outlet of label requests as the mapper has it, which never waits."""
    return Outlet(
        Out(LABEL_REQUEST, is_nonblocking=True),
        "mapper",
        1,
        transport,
        ("vlm_labeller",),
        with_backlog=("vlm_labeller",),
    )


async def test_slow_labeller_has_room_for_two_requests_and_loses_none() -> None:
    transport, gate, results = MemoryTransport(), Event(), []
    transport.subscribe(
        LABEL_RESULT.name, lambda _, body: results.append(decode(body, LabelResult))
    )
    labeller = FakeLabeller([("cup", 0.5)], gate)
    mapper = mapper_outlet(transport)
    assert mapper.credits() == 0, "a labeller that is absent has no room"
    async with running(stage(transport, labeller)):
        await eventually(lambda: mapper.credits() == 2)
        for region in range(5):
            await send(mapper, request(region))
        assert mapper.credits() == 0
        assert results == [], "sending waits for no result"
        gate.set()
        await eventually(lambda: len(results) == 5)
        await eventually(lambda: mapper.credits() == 2)
    assert [answer.region for answer in results] == [0, 1, 2, 3, 4]


async def test_added_name_is_handled_before_queued_requests() -> None:
    transport, gate, topic_names = MemoryTransport(), Event(), []
    for topic in (LABEL_RESULT, LABEL_NAMES):
        transport.subscribe(topic.name, lambda *_, name=topic.name: topic_names.append(name))
    labeller = FakeLabeller([("cup", 0.5)], gate)
    mapper = mapper_outlet(transport)
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    async with running(stage(transport, labeller)):
        for region in range(5):
            await send(mapper, request(region))
        await eventually(lambda: labeller.seen)
        await send(operator, AddLabel(stamp_ns=1, name="teapot"))
        gate.set()
        await eventually(lambda: len(topic_names) == 6)
    assert topic_names == [LABEL_RESULT.name, LABEL_NAMES.name, *[LABEL_RESULT.name] * 4]


async def test_added_names_survive_a_restart_of_the_stage(pair: Path, names: Path) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    store, transport, name_lists = MemoryStore(), MemoryTransport(), []
    transport.subscribe(
        LABEL_NAMES.name, lambda _, body: name_lists.append(decode(body, LabelNames))
    )
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    for name, count in (("blue", 3), ("teapot", 4)):
        one = Stage(lambda: VlmLabeller(config), transport, config=QUICK, store=store)
        async with running(one) as tasks:
            await send(operator, AddLabel(stamp_ns=count, name=name))
            await eventually(lambda count=count: name_lists and name_lists[-1].stamp_ns == count)
            one.drain()
            await asyncio.gather(*tasks)
        assert len(name_lists[-1].names) == count


async def run_recorded(folder: Path, config: VlmLabellerConfig) -> list[LabelResult]:
    """Record two requests with a name added between them, and return the results."""
    transport, results = MemoryTransport(), []
    transport.subscribe(
        LABEL_RESULT.name, lambda _, body: results.append(decode(body, LabelResult))
    )
    settings = VlmLabellerSettings(config.model, config.url, class_names=config.names)
    whole = Config(vlm_labeller=settings)
    journal = open_recorder(folder, "vlm_labeller", "robot", whole)
    one = Stage(lambda: VlmLabeller(config), transport, config=QUICK, journal=journal)
    mapper = mapper_outlet(transport)
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    async with running(one) as tasks:
        await send(mapper, request(0, "blue"))
        await eventually(lambda: len(results) == 1)
        await send(operator, AddLabel(stamp_ns=1, name="blue"))
        await send(mapper, request(1, "blue"))
        await eventually(lambda: len(results) == 2)
        one.drain()
        await asyncio.gather(*tasks)
    return results


async def test_encoders_replay_with_added_names(tmp_path: Path, pair: Path, names: Path) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    results = await run_recorded(tmp_path / "recording", config)
    assert results[1].label == "blue"
    (replayed,) = open_recording(tmp_path / "recording")
    assert replayed.verify().made == {LABEL_RESULT.name: 2, LABEL_NAMES.name: 1}
    names.write_text("red\nblue\n")
    with pytest.raises(ReplayDiverged, match="label/result"):
        replayed.verify()


async def test_replay_sends_no_requests_to_the_server(tmp_path: Path, names: Path) -> None:
    names.write_text("red\n")
    with serving(replies_with("blue", 0.5)) as server:
        config = VlmLabellerConfig(url=server.url, names=str(names))
        results = await run_recorded(tmp_path / "recording", config)
        count = len(server.requests)
        (replayed,) = open_recording(tmp_path / "recording")
        result = replayed.verify()
        assert len(server.requests) == count == 2
    assert [answer.label for answer in results] == ["", "blue"]
    assert (result.steps, result.made) == (4, {})
