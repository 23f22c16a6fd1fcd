"""The command `ldo query` for a finished run and for a running service."""

import json
import shutil
from contextlib import nullcontext
from pathlib import Path
from unittest.mock import Mock

import msgspec
import numpy as np
import pytest
import zenoh

from ldo_service.client import connect
from ldo_service.commands import query
from ldo_service.demo_networks import IMAGE_ENCODER
from ldo_service.errors import ConfigError
from ldo_service.geometry import Trajectory
from ldo_service.runs.records import OBJECTS, read_objects, write_objects
from ldo_service.schemas import MapObjects, Pose, encode
from ldo_service.schemas.topics import MAP_OBJECTS
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.detection.sentence_encoders import TinyEncoder, write_vocabulary
from tests.ports import free_endpoint
from tests.schemas.examples import EXAMPLES

EXAMPLE = EXAMPLES["map_objects"]
assert isinstance(EXAMPLE, MapObjects)
PLANT = EXAMPLE.objects[0]


def map_object(number: int, name: str, probability: float, x_m: float) -> msgspec.Struct:
    return msgspec.structs.replace(
        PLANT,
        id=number,
        name=name,
        confidence=probability,
        distribution=((name, probability),),
        T_map_object=Pose((x_m, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0)),
        size=(0.5, 0.25, 1.0),
    )


OBJECTS_IN_MAP = (
    map_object(1, "chair", 0.9, 3.0),
    map_object(4, "couch", 0.8, -1.0),
    map_object(5, "chair", 0.9, 1.5),
    map_object(9, "chair", 0.95, 7.0),
)
OBJECTS_MESSAGE = msgspec.structs.replace(EXAMPLE, objects=OBJECTS_IN_MAP)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Files of a run that the command reads; the last camera position is x = 1 m."""
    write_objects(tmp_path, OBJECTS_MESSAGE)
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1, 0, 3] = 1
    Trajectory(np.array([0.0, 1.0]), T).save(tmp_path / "trajectory.txt")
    return tmp_path


@pytest.mark.parametrize("submap", [0, 3])
def test_distance_is_unknown_in_an_unmerged_submap(
    capsys, monkeypatch: pytest.MonkeyPatch, submap: int
) -> None:
    here = Pose((1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    map_origin = Pose((0.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
    pose = msgspec.structs.replace(
        EXAMPLES["tracked_pose"], T_odom_camera=here, T_map_odom=map_origin, submap=submap
    )
    service = Mock(objects=lambda: OBJECTS_MESSAGE, latest=lambda _topic: [pose])
    monkeypatch.setattr(query, "connect", lambda *_: nullcontext(service))
    _, out, _ = ldo(capsys, "query", "live", "couch", "--json")
    (answer,) = json.loads(out)
    assert answer["distance"] == (None if submap else 2.0)


def test_objects_are_read_back_from_their_file(folder: Path) -> None:
    assert read_objects(folder) == OBJECTS_MESSAGE
    before = (folder / OBJECTS).read_bytes()
    write_objects(folder, read_objects(folder))
    assert (folder / OBJECTS).read_bytes() == before
    plain = json.loads(before)
    assert plain["objects"][1]["T_map_object"]["translation"] == [-1.0, 0.0, 0.0]


def test_objects_are_sorted_by_score_and_then_by_distance(capsys, folder: Path) -> None:
    code, out, _ = ldo(capsys, "query", folder, "chair", "--json")
    assert code == 0
    answers = json.loads(out)
    assert [one["id"] for one in answers] == [9, 5, 1]
    assert answers[1] == {
        "id": 5,
        "name": "chair",
        "score": 0.9,
        "center": [1.5, 0.0, 0.0],
        "size": [0.5, 0.25, 1.0],
        "distance": 0.5,
        "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0],
    }


def test_synonym_finds_the_object_and_prints_a_table(capsys, folder: Path) -> None:
    code, out, _ = ldo(capsys, "query", folder, "Sofa")
    assert code == 0
    (row,) = [line for line in out.splitlines() if "couch" in line]
    for cell in ("4", "0.80", "-1.00 0.00 0.00", "0.50 0.25 1.00", "2.00"):
        assert cell in row


@pytest.mark.parametrize(
    ("text", "complaint"),
    [("chiar", "Did you mean chair?"), ("piano", "The names in the map are chair, couch.")],
)
def test_query_without_a_match_names_the_known_labels(
    capsys, folder: Path, text: str, complaint: str
) -> None:
    code, out, err = ldo(capsys, "query", folder, text)
    assert (code, out) == (3, "")
    assert_one_paragraph(err)
    assert complaint in err


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        (None, "had neither a detector nor a labeller"),
        (b"{", "does not have the format that `ldo run` writes"),
        (b"\xff\xfe", "does not have the format that `ldo run` writes"),
        (
            json.dumps({"type": "MapObjects"}).encode(),
            "does not have the format that `ldo run` writes",
        ),
        (
            msgspec.json.encode(msgspec.structs.replace(OBJECTS_MESSAGE, objects=())),
            "has no objects yet",
        ),
    ],
)
def test_a_run_without_objects_is_bad_data(capsys, tmp_path: Path, content, complaint) -> None:
    if content is not None:
        (tmp_path / OBJECTS).write_bytes(content)
    code, _, err = ldo(capsys, "query", tmp_path, "chair")
    assert code == 3
    assert_one_paragraph(err)
    assert complaint in err


def test_missing_folder_is_bad_data(capsys, tmp_path: Path) -> None:
    code, _, err = ldo(capsys, "query", tmp_path / "absent", "chair")
    assert code == 3
    assert_one_paragraph(err)
    assert "is not a folder" in err


# --- text embeddings ------------------------------------------------------------------------------
@pytest.fixture
def pair(tmp_path: Path) -> Path:
    """A pair of encoders that embeds a throne close to a chair, and a piano far from it."""
    folder = tmp_path / "pair"
    folder.mkdir()
    shutil.copy(IMAGE_ENCODER, folder)
    rows = np.zeros((4, 96))
    rows[0, 0] = rows[2, 1] = rows[3, 2] = 1
    rows[1, :2] = 0.95, np.sqrt(1 - 0.95**2)
    names = np.array(["chair", "throne", "couch", "piano"])
    np.savez(folder / "embeddings.npz", names=names, embeddings=rows)
    return folder


def test_word_without_synonym_is_found_by_text_embedding(capsys, folder: Path, pair: Path) -> None:
    code, _, err = ldo(capsys, "query", folder, "throne")
    assert (code, "--model NAME" in err) == (3, True)
    code, out, _ = ldo(capsys, "query", folder, "throne", "--model", pair, "--json")
    assert code == 0
    answers = json.loads(out)
    assert [one["id"] for one in answers] == [9, 5, 1]
    assert answers[0]["score"] == pytest.approx(0.95 * 0.95, abs=1e-3)
    for word, is_known in (("piano", True), ("unicorn", False)):
        code, _, err = ldo(capsys, "query", folder, word, "--model", pair)
        assert (code, "none of 4 objects" in err) == (3, True)
        assert ("has no vector for 'unicorn'" in err) != is_known
        assert_one_paragraph(err)


def test_query_uses_the_labeller_model_of_the_run(capsys, folder: Path, pair: Path) -> None:
    (folder / "config.yaml").write_text(f"vlm_labeller: {{model: {pair}}}\n")
    code, out, _ = ldo(capsys, "query", folder, "throne", "--json")
    assert (code, [one["id"] for one in json.loads(out)]) == (0, [9, 5, 1])
    shutil.rmtree(pair)
    code, _, err = ldo(capsys, "query", folder, "throne")
    assert (code, "none of 4 objects" in err, "--model NAME" in err) == (3, True, True)
    assert_one_paragraph(err)
    assert ldo(capsys, "query", folder, "sofa")[0] == 0


def test_unusable_model_is_a_configuration_error_only_when_needed(capsys, folder: Path) -> None:
    assert ldo(capsys, "query", folder, "chair", "--model", "absent")[0] == 0, (
        "the model is not needed for a known label"
    )
    code, _, err = ldo(capsys, "query", folder, "throne", "--model", "absent")
    assert code == 2
    assert_one_paragraph(err)


# --- sentence encoders ----------------------------------------------------------------------------
def test_registered_sentence_encoder_ranks_objects(
    capsys, monkeypatch: pytest.MonkeyPatch, folder: Path, tmp_path: Path
) -> None:
    monkeypatch.setenv("LDO_MODELS", str(tmp_path / "models"))
    network = TinyEncoder().network(tmp_path / "m.onnx")
    words = write_vocabulary(tmp_path / "vocab.txt")
    assert ldo(capsys, "query", folder, "sit")[0] == 3
    assert ldo(capsys, "models", "add", "tiny", network, "--tokenizer", words)[0] == 0
    code, out, _ = ldo(capsys, "query", folder, "sit", "--json")
    answers = json.loads(out)
    assert (code, [one["id"] for one in answers]) == (0, [9, 5, 1, 4])
    assert answers[-1]["score"] == pytest.approx(0.8 * 0.8, abs=1e-6)
    code, _, err = ldo(capsys, "query", folder, "piano")
    assert (code, "The nearest names, with their cosines, are" in err) == (3, True)
    assert_one_paragraph(err)
    assert ldo(capsys, "models", "add", "other", network, "--tokenizer", words)[0] == 0
    code, _, err = ldo(capsys, "query", folder, "sit")
    assert (code, "other, tiny" in err) == (3, True)
    assert_one_paragraph(err)
    assert ldo(capsys, "query", folder, "sit", "--model", "tiny")[0] == 0
    (tmp_path / "models" / "tiny" / "vocab.txt").write_text("damaged")
    assert ldo(capsys, "query", folder, "sit", "--model", "tiny")[0] == 2


# --- live -----------------------------------------------------------------------------------------
def test_query_without_a_running_service_has_its_own_exit_code(capsys) -> None:
    code, _, err = ldo(capsys, "query", "live", "chair", "--endpoint", free_endpoint())
    assert code == 6
    assert_one_paragraph(err)


def test_live_query_receives_objects_of_the_running_service(capsys) -> None:
    """A router replies in place of the stage of the mapper."""
    endpoint = free_endpoint()
    config = zenoh.Config.from_json5(
        json.dumps(
            {
                "mode": "router",
                "listen": {"endpoints": [endpoint]},
                "scouting": {"multicast": {"enabled": False}, "gossip": {"enabled": False}},
            }
        )
    )
    key = MAP_OBJECTS.expression("robot")

    def reply(query: zenoh.Query) -> None:
        with query:
            query.reply(key, encode(OBJECTS_MESSAGE))

    handler = zenoh.handlers.Callback(reply, indirect=False)
    with zenoh.open(config) as router:
        with connect("robot", endpoint) as service, pytest.raises(ConfigError, match="map/objects"):
            service.objects(timeout_s=0.5)
        with router.declare_queryable(key, handler):
            with connect("robot", endpoint) as service:
                assert service.objects() == OBJECTS_MESSAGE
            code, out, _ = ldo(capsys, "query", "live", "sofa", "--json", "--endpoint", endpoint)
    assert code == 0
    (one,) = json.loads(out)
    assert (one["id"], one["distance"]) == (4, None)
