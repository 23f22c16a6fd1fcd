"""Sentence encoder all-MiniLM-L6-v2 from registration to query; skipped without its package."""

import json
from pathlib import Path

import msgspec
import numpy as np
import onnxruntime
import pytest
from tokenizers import Tokenizer

from ldo_service.detection.sentence_encoder import SentenceEncoder
from ldo_service.detection.vocabulary import COCO
from ldo_service.runs.records import write_objects
from ldo_service.schemas import MapObjects
from tests.commands.test_cli import ldo
from tests.schemas.examples import EXAMPLES

from .minilm import package_folder, write_minilm


@pytest.fixture(scope="module")
def folder() -> Path:
    return package_folder()


@pytest.fixture(scope="module")
def network(folder: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("minilm") / "model.onnx"
    return write_minilm(folder / "model.safetensors", path)


@pytest.mark.parametrize("tokenizer", ["tokenizer.json", "vocab.txt"])
def test_cosines_match_those_published_by_its_authors(
    network: Path, folder: Path, tokenizer: str
) -> None:
    """The quickstart of sentence-transformers prints these cosines for this network."""
    texts = ["The weather is lovely today.", "It's so sunny outside!", "He drove to the stadium."]
    rows = SentenceEncoder(network, folder / tokenizer).encode(texts)
    published = [[1, 0.6660, 0.1046], [0.6660, 1, 0.1411], [0.1046, 0.1411, 1]]
    np.testing.assert_allclose(rows @ rows.T, published, atol=1e-4)


def test_embedding_matches_a_plain_computation_with_padding(network: Path, folder: Path) -> None:
    tokenizer = Tokenizer.from_file(str(folder / "tokenizer.json"))
    encoded = tokenizer.encode("something to sit on")  # This file pads each text to 128 tokens.
    mask = np.array([encoded.attention_mask])
    inputs = {"input_ids": np.array([encoded.ids]), "attention_mask": mask}
    inputs["token_type_ids"] = np.zeros_like(mask)
    (hidden,) = onnxruntime.InferenceSession(network).run(["last_hidden_state"], inputs)
    mean = hidden[0][mask[0] == 1].mean(axis=0)
    (row,) = SentenceEncoder(network, folder / "tokenizer.json").encode(["something to sit on"])
    np.testing.assert_allclose(row, mean / np.linalg.norm(mean), atol=1e-5)


def test_nearest_names_have_a_similar_meaning(network: Path, folder: Path) -> None:
    encoder = SentenceEncoder(network, folder / "vocab.txt")
    names = encoder.encode(COCO)

    def nearest(text: str, count: int) -> set[str]:
        order = np.argsort(-(names @ encoder.encode([text])[0]))
        return {COCO[index] for index in order[:count]}

    assert nearest("sofa", 1) == {"couch"}
    assert nearest("place to sit", 3) & {"chair", "couch"}
    assert nearest("refrigerator for food", 1) == {"refrigerator"}


def test_query_ranks_objects_by_meaning(
    capsys, monkeypatch: pytest.MonkeyPatch, tmp_path: Path, network: Path, folder: Path
) -> None:
    monkeypatch.setenv("LDO_MODELS", str(tmp_path / "models"))
    example = EXAMPLES["map_objects"]
    assert isinstance(example, MapObjects)
    objects = tuple(
        msgspec.structs.replace(example.objects[0], id=i, name=name, distribution=((name, 1.0),))
        for i, name in enumerate(("oven", "couch", "clock", "chair"))
    )
    write_objects(tmp_path, msgspec.structs.replace(example, objects=objects))
    query = ("query", tmp_path, "something to sit on", "--json")
    assert ldo(capsys, *query)[0] == 3
    add = ("models", "add", "minilm", network, "--tokenizer", folder / "tokenizer.json")
    assert ldo(capsys, *add)[0] == 0
    code, out, _ = ldo(capsys, *query)
    assert (code, [one["name"] for one in json.loads(out)]) == (0, ["chair", "couch"])
