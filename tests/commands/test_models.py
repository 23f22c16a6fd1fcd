"""The command `ldo models`, and the use of registered models by other commands."""

import re
from pathlib import Path

import pytest

from ldo_service.commands import doctor
from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig
from ldo_service.detection.model_registry import Models
from ldo_service.detection.open_networks import open_detector, open_labeller
from ldo_service.errors import ModelError
from tests.commands.test_cli import assert_one_paragraph, ldo
from tests.detection.labellers.encoders import ColorPair, vocabulary
from tests.detection.networks import SQUARES
from tests.detection.sentence_encoders import TinyEncoder, write_vocabulary


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("LDO_MODELS", str(tmp_path / "models"))
    return tmp_path / "models"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return SQUARES["yolov5"].write(tmp_path / "squares.onnx")


def test_model_is_added_listed_and_removed(capsys, file: Path, tmp_path: Path) -> None:
    (tmp_path / "LICENSE").write_text("License of squares\n\nAll rights reversed.\n")
    license = ("--license", tmp_path / "LICENSE")
    code, out, _ = ldo(capsys, "models", "add", "mine", file, *license)
    assert code == 0
    assert "mine is registered: yolov5, 3 classes (red, green, blue" in out
    assert Models().get("mine").about.license.endswith("All rights reversed.\n")
    code, out, _ = ldo(capsys, "models", "list")
    assert code == 0
    for word in ("mine", "yolov5", "License of squares", Models().get("mine").about.sha256[:12]):
        assert word in out
    assert ldo(capsys, "models", "remove", "mine")[0] == 0
    code, out, _ = ldo(capsys, "models", "list")
    assert code == 0
    assert "ldo models add NAME FILE" in out


def test_a_pair_is_added_by_its_files(capsys, tmp_path: Path) -> None:
    image, text = ColorPair().image(tmp_path / "i.onnx"), ColorPair().text(tmp_path / "t.onnx")
    merges, names = vocabulary(tmp_path / "bpe.gz"), tmp_path / "names.txt"
    names.write_text("red\nblue\n")
    add = ("models", "add", "colors", image, "--text", text)
    code, _, err = ldo(capsys, *add)
    assert (code, "--vocabulary" in err) == (2, True)
    assert_one_paragraph(err)
    code, out, _ = ldo(capsys, *add, "--vocabulary", merges, "--names", names)
    assert code == 0
    assert "colors is registered: clip, 2 classes (red, blue" in out
    (finding,) = doctor.networks()
    assert finding.text == "network colors: clip, 2 classes"
    code, _, err = ldo(capsys, *add, "--vocabulary", merges, "--layout", "yolox")
    assert (code, "applies to a detector" in err) == (2, True)


def test_license_can_be_given_as_text(capsys, file: Path) -> None:
    ldo(capsys, "models", "add", "mine", file, "--license", "Apache-2.0, of the authors" * 20)
    assert Models().get("mine").about.license == "Apache-2.0, of the authors" * 20


def test_invalid_network_file_is_refused_in_one_paragraph(
    capsys, tmp_path: Path, folder: Path
) -> None:
    (tmp_path / "net.onnx").write_text("garbage")
    code, _, err = ldo(capsys, "models", "add", "mine", tmp_path / "net.onnx")
    assert code == 2
    assert_one_paragraph(err)
    assert not list(folder.iterdir())


def test_a_wrong_layout_is_refused(capsys, file: Path) -> None:
    code, _, err = ldo(capsys, "models", "add", "mine", file, "--layout", "yolov8")
    assert code == 2
    assert_one_paragraph(err)


@pytest.mark.parametrize("verb", ["run", "simulate"])
def test_offline_run_with_an_unknown_model_does_not_start(
    capsys, tmp_path: Path, verb: str
) -> None:
    out = ("--out", tmp_path / "out") if verb == "run" else ()
    code, _, err = ldo(capsys, verb, "synthetic:room", *out, "--set", "detector.model=nothing")
    assert code == 2
    assert_one_paragraph(err)
    assert "ldo models add" in err
    assert not (tmp_path / "out").exists()


def test_doctor_reports_missing_and_damaged_models(capsys, file: Path) -> None:
    (finding,) = doctor.networks()
    assert finding.mark == "absent"
    assert "ldo models add" in finding.text
    ldo(capsys, "models", "add", "mine", file)
    (finding,) = doctor.networks()
    assert (finding.mark, finding.text) == ("ok", "network mine: yolov5, 3 classes")
    Models().get("mine").file.write_bytes(b"garbage")
    (finding,) = doctor.networks()
    assert finding.mark == "bad"
    code, out, _ = ldo(capsys, "models", "list")
    assert code == 1
    assert "damaged" in out


@pytest.mark.parametrize(
    ("network", "tokenizer", "complaint"),
    [
        ("cut", "whole", "m.onnx cannot be used .* no network in ONNX"),
        ("whole", "cut", "is not a vocabulary of WordPiece"),
        ("whole", "other", "[01] of 8 words, such as sofa"),
        ("whole", "long", "inference of the network fails: .* out of data bounds"),
        ("other", "whole", "output has the shape"),
        ("constant", "whole", "1 of 8 words, such as sofa"),
        ("text", "whole", "something else than numbers"),
    ],
)
def test_invalid_sentence_encoder_is_refused_in_one_paragraph(
    capsys, tmp_path: Path, network: str, tokenizer: str, complaint: str
) -> None:
    kinds = {"other": TinyEncoder(is_pooled=True), "constant": TinyEncoder(is_constant=True)}
    kinds["text"] = TinyEncoder(is_text=True)
    model = kinds.get(network, TinyEncoder()).network(tmp_path / "m.onnx")
    if network == "cut":
        model.write_bytes(model.read_bytes()[:200])
    words = write_vocabulary(tmp_path / "vocab.txt")
    special, names = words.read_text().split()[:4], words.read_text().split()[4:]
    changed = {"cut": special[:2], "other": special + names[1:] + names[:1]}
    changed["long"] = special + ["unused"] * 9 + names
    words.write_text("\n".join(changed.get(tokenizer, special + names)))
    code, _, err = ldo(capsys, "models", "add", "tiny", model, "--tokenizer", words)
    assert code == 2
    assert re.search(complaint, err)
    assert_one_paragraph(err)
    assert Models().names == []


def test_sentence_encoder_is_added_listed_and_not_used_as_another_network(
    capsys, tmp_path: Path
) -> None:
    network = TinyEncoder().network(tmp_path / "m.onnx")
    add = ("models", "add", "tiny", network)
    code, _, err = ldo(capsys, *add)
    assert (code, "--tokenizer FILE" in err) == (2, True)
    assert_one_paragraph(err)
    code, _, err = ldo(capsys, *add, "--tokenizer", tmp_path / "absent.json")
    assert (code, "absent.json is not a file" in err) == (2, True)
    words = ("--tokenizer", write_vocabulary(tmp_path / "words.txt"))
    code, _, err = ldo(capsys, *add, *words, "--layout", "yolox")
    assert (code, "takes no --layout" in err) == (2, True)
    code, out, _ = ldo(capsys, *add, *words)
    assert (code, "tiny is registered: sentence encoder" in out) == (0, True)
    (finding,) = doctor.networks()
    assert finding.text == "network tiny: sentence encoder"
    code, out, _ = ldo(capsys, "models", "list")
    assert (code, "sentence" in out) == (0, True)
    with pytest.raises(ModelError, match="sentence encoder"):
        open_detector("tiny", NetworkConfig())
    with pytest.raises(ModelError, match="sentence encoder"):
        open_labeller("tiny", DualEncoderConfig())
    (Models().get("tiny").folder / "vocab.txt").write_text("[CLS]\n")
    code, out, _ = ldo(capsys, "models", "list")
    assert (code, "damaged" in out) == (1, True)
