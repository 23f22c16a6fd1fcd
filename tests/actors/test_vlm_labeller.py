"""Names for regions, and what becomes of labellers that fail, hang or are not there."""

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
from ldo_service.detection.labellers import Opinion
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
from ldo_service.storage.state_store import MemoryStore
from ldo_service.transport.interface import MemoryTransport
from tests.detection.labellers.encoders import ColorPair, embeddings, plain_image, vocabulary
from tests.detection.labellers.server import hangs, replies_with, responds, serving
from tests.runtime.fake_actors import QUICK, eventually, running, send


def crop_message(color: np.ndarray) -> Image:
    """A crop [h, w, 3] uint8 RGB as JPEG."""
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


def only(messages) -> LabelResult:
    (message,) = messages
    assert isinstance(message, LabelResult)
    return message


def added(actor: VlmLabeller, name: str) -> LabelNames:
    (answer,) = actor.handle(AddLabel(stamp_ns=5, name=name))
    assert isinstance(answer, LabelNames)
    return answer


@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A folder with a pair of encoders and a text encoder."""
    folder = tmp_path / "colours"
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


class Scripted:
    """Says what it is told, waits where it is told."""

    identity, names = "scripted 1", ("cup",)

    def __init__(self, opinions: list[Opinion], gate: Event | None = None) -> None:
        self.opinions, self.gate = opinions, gate
        self.seen: list[int] = []

    def label(self, crops: Sequence[np.ndarray]) -> list[Opinion]:
        self.seen.append(len(crops))
        if self.gate:
            assert self.gate.wait(60)
        return self.opinions

    def add(self, name: str) -> None:
        self.names = (*self.names, name)

    def metrics(self) -> dict[str, float]:
        return {"names": len(self.names)}


# --- answers --------------------------------------------------------------------------------------
def test_a_region_gets_its_name(pair: Path, names: Path) -> None:
    actor = VlmLabeller(VlmLabellerConfig(model=str(pair), names=str(names)))
    answer = only(actor.handle(request(region=12, color="green")))
    assert (answer.region, answer.keyframe, answer.stamp_ns) == (12, 3, 1012)
    assert answer.label == "green"
    assert 0.9 < answer.confidence <= 1
    assert answer.labeller.startswith("colours ")
    facts = actor.metrics()
    assert (facts["labellers"], facts["regions_named"], facts["names"]) == (1, 1, 2)


def test_it_tells_what_else_a_region_may_be() -> None:
    told = [("cup", 0.5), ("vase", 0.3), ("bowl", 0.1)]
    answer = only(VlmLabeller(labeller=Scripted(told)).handle(request()))
    assert (answer.label, answer.alternatives) == ("cup", (("vase", 0.3), ("bowl", 0.1)))
    many = [(f"name {k}", 0.01) for k in range(99)]
    assert (
        len(only(VlmLabeller(labeller=Scripted(many)).handle(request())).alternatives)
        == MAX_ALTERNATIVES
    )


def test_without_a_labeller_it_idles_and_answers_at_once() -> None:
    actor = VlmLabeller()
    answer = only(actor.handle(request()))
    assert (answer.label, answer.confidence, answer.labeller) == ("", 0, "")
    assert (actor.metrics()["labellers"], actor.metrics()["labellers_missing"]) == (0, 0)
    assert "vlm_labeller.model" in added(actor, "teapot").error


def test_no_opinion_is_told_from_nobody_who_could_look() -> None:
    answer = only(VlmLabeller(labeller=Scripted([])).handle(request()))
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
def test_a_labeller_that_cannot_be_used_is_said_once_and_the_service_goes_on(
    tmp_path: Path, caplog, config: dict
) -> None:
    if config.get("model") == "garbage":
        (tmp_path / "model.onnx").write_text("garbage")
        (tmp_path / "embeddings.npz").write_text("garbage")
        config = {"model": str(tmp_path)}
    actor = VlmLabeller(VlmLabellerConfig(**config))
    for _ in range(3):
        assert only(actor.handle(request())).labeller == ""
    (record,) = caplog.records
    assert record.levelno == logging.ERROR
    assert actor.metrics()["labellers_missing"] == 1
    with pytest.raises(ConfigError):
        require_labeller(VlmLabellerConfig(**config))


def test_failures_are_counted_and_told_once_until_it_works_again(caplog) -> None:
    class Failing(Scripted):
        def label(self, crops: Sequence[np.ndarray]) -> list[Opinion]:
            if len(self.seen) in (1, 2):
                self.seen.append(0)
                raise EndpointError("it is down.") if len(self.seen) == 2 else ModelError("NaN.")
            return super().label(crops)

    actor = VlmLabeller(labeller=Failing([("cup", 0.5)]))
    caplog.set_level(logging.INFO)
    answers = [only(actor.handle(request())) for _ in range(5)]
    assert [answer.label for answer in answers] == ["cup", "", "", "cup", "cup"]
    assert [bool(answer.labeller) for answer in answers] == [True, False, False, True, True]
    assert len(caplog.records) == 2
    assert actor.metrics()["labellings_failed"] == 2
    assert actor.metrics()["labeller_failing"] == 0


def test_a_crop_that_is_no_image_leaves_its_region_unnamed() -> None:
    labeller = Scripted([("cup", 0.5)])
    broken = Image(encoding="jpeg", width=9, height=9, data=memoryview(b"no jpeg"))
    answer = only(VlmLabeller(labeller=labeller).handle(request(crops=(broken,))))
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
def test_whatever_a_server_does_nothing_is_mislabelled(
    tmp_path: Path, behaves, facts: dict[str, float]
) -> None:
    (tmp_path / "names.txt").write_text("cup\nvase\n")
    quick = HttpClientConfig(timeout_s=0.2, attempts=1, per_minute=1e9)
    with serving(behaves) as server:
        config = VlmLabellerConfig(
            url=server.url, names=str(tmp_path / "names.txt"), http=HttpConfig(endpoint=quick)
        )
        actor = VlmLabeller(config)
        answer = only(actor.handle(request()))
    is_good = "regions_named" in facts
    assert (answer.label, answer.confidence) == (
        ("cup", pytest.approx(0.75)) if is_good else ("", 0)
    )
    assert facts.items() <= actor.metrics().items()


def test_a_model_and_a_server_are_one_too_many() -> None:
    with pytest.raises(ConfigError, match="choose one"):
        VlmLabellerConfig(model="clip", url="http://127.0.0.1:1/v1")


# --- names that are added -------------------------------------------------------------------------
def test_a_name_that_is_added_is_found_and_survives_a_restart(pair: Path, names: Path) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    first, plain_one = VlmLabeller(config), VlmLabeller(config)
    assert added(first, "Blue").names == ("red", "green", "blue")
    state = first.snapshot()
    assert first.snapshot() is state, "nothing new is written"
    successor = VlmLabeller(config)
    successor.restore(state)
    for actor in (first, successor):
        assert only(actor.handle(request(color="blue"))).label == "blue"
    assert only(plain_one.handle(request(color="blue"))).confidence < 0.6
    assert successor.metrics()["names_added"] == 1


def test_a_name_that_cannot_be_placed_is_refused_and_later_remembered(
    tmp_path: Path, pair: Path, caplog
) -> None:
    ColorPair().image(tmp_path / "model.onnx")
    embeddings(tmp_path / "embeddings.npz")
    cached = VlmLabeller(VlmLabellerConfig(model=str(tmp_path)))
    answer = added(cached, "teapot")
    assert "--text and --vocabulary" in answer.error
    assert answer.names == ("red", "green", "blue")
    assert cached.metrics()["names_refused"] == 1
    cached.restore({"added": ["teapot"]})
    assert "saved name 'teapot' not added" in caplog.text
    able = VlmLabeller(VlmLabellerConfig(model=str(pair)))
    able.restore(cached.snapshot())
    assert "teapot" in added(able, "samovar").names


# --- at work --------------------------------------------------------------------------------------
def stage(transport: MemoryTransport, labeller: Scripted, **fields) -> Stage:
    return Stage(lambda: VlmLabeller(labeller=labeller), transport, config=QUICK, **fields)


async def test_a_slow_labeller_keeps_the_newest_of_each_region_and_no_more_than_32() -> None:
    transport, gate, heard = MemoryTransport(), Event(), []
    transport.subscribe(LABEL_RESULT.name, lambda _, body: heard.append(decode(body, LabelResult)))
    labeller = Scripted([("cup", 0.5)], gate)
    slow = stage(transport, labeller)
    mapper = Outlet(Out(LABEL_REQUEST), "mapper", 1, transport)
    async with running(slow):
        await send(mapper, request(0))
        await eventually(lambda: labeller.seen)
        for region in (1, 1, 1, *range(2, 41)):
            await send(mapper, request(region, crops=(crop_message(plain_image("red")),) * 2))
        await eventually(lambda: slow.health().inputs[0].queued == 32)
        assert len(heard) == 0, "nobody waited for an answer"
        gate.set()
        await eventually(lambda: len(heard) == 33)
        dropped = slow.health().inputs[0].dropped
    assert [answer.region for answer in heard] == [0, *range(9, 41)]
    assert dropped == 2 + 8


async def test_who_adds_a_name_waits_for_one_region_and_not_for_all_that_wait() -> None:
    transport, gate, said = MemoryTransport(), Event(), []
    for topic in (LABEL_RESULT, LABEL_NAMES):
        transport.subscribe(topic.name, lambda *_, name=topic.name: said.append(name))
    labeller = Scripted([("cup", 0.5)], gate)
    mapper = Outlet(Out(LABEL_REQUEST), "mapper", 1, transport)
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    async with running(stage(transport, labeller)):
        for region in range(5):
            await send(mapper, request(region))
        await eventually(lambda: labeller.seen)
        await send(operator, AddLabel(stamp_ns=1, name="teapot"))
        gate.set()
        await eventually(lambda: len(said) == 6)
    assert said == [LABEL_RESULT.name, LABEL_NAMES.name, *[LABEL_RESULT.name] * 4]


async def test_a_state_survives_the_stage(pair: Path, names: Path) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    store, transport, told = MemoryStore(), MemoryTransport(), []
    transport.subscribe(LABEL_NAMES.name, lambda _, body: told.append(decode(body, LabelNames)))
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    for name, count in (("blue", 3), ("teapot", 4)):
        one = Stage(lambda: VlmLabeller(config), transport, config=QUICK, store=store)
        async with running(one) as tasks:
            await send(operator, AddLabel(stamp_ns=count, name=name))
            await eventually(lambda count=count: told and told[-1].stamp_ns == count)
            one.drain()
            await asyncio.gather(*tasks)
        assert len(told[-1].names) == count


async def recorded(folder: Path, config: VlmLabellerConfig) -> list[LabelResult]:
    """A life with two regions and a name between them."""
    transport, heard = MemoryTransport(), []
    transport.subscribe(LABEL_RESULT.name, lambda _, body: heard.append(decode(body, LabelResult)))
    settings = VlmLabellerSettings(config.model, config.url, class_names=config.names)
    whole = Config(vlm_labeller=settings)
    journal = open_recorder(folder, "vlm_labeller", "robot", whole)
    one = Stage(lambda: VlmLabeller(config), transport, config=QUICK, journal=journal)
    mapper = Outlet(Out(LABEL_REQUEST), "mapper", 1, transport)
    operator = Outlet(Out(LABEL_ADD), "operator", 1, transport)
    async with running(one) as tasks:
        await send(mapper, request(0, "blue"))
        await eventually(lambda: len(heard) == 1)
        await send(operator, AddLabel(stamp_ns=1, name="blue"))
        await send(mapper, request(1, "blue"))
        await eventually(lambda: len(heard) == 2)
        one.drain()
        await asyncio.gather(*tasks)
    return heard


async def test_encoders_replay_with_the_names_that_were_added(
    tmp_path: Path, pair: Path, names: Path
) -> None:
    config = VlmLabellerConfig(model=str(pair), names=str(names))
    heard = await recorded(tmp_path / "recording", config)
    assert heard[1].label == "blue"
    (replayed,) = open_recording(tmp_path / "recording")
    assert replayed.verify().made == {LABEL_RESULT.name: 2, LABEL_NAMES.name: 1}
    names.write_text("red\nblue\n")
    with pytest.raises(ReplayDiverged, match="label/result"):
        replayed.verify()


async def test_a_server_is_not_asked_again_in_a_replay(tmp_path: Path, names: Path) -> None:
    names.write_text("red\n")
    with serving(replies_with("blue", 0.5)) as server:
        config = VlmLabellerConfig(url=server.url, names=str(names))
        heard = await recorded(tmp_path / "recording", config)
        asked = len(server.requests)
        (replayed,) = open_recording(tmp_path / "recording")
        result = replayed.verify()
        assert len(server.requests) == asked == 2
    assert [answer.label for answer in heard] == ["", "blue"]
    assert (result.steps, result.made) == (4, {})
