"""Model registry: registration, verification and removal of networks."""

import json
from pathlib import Path

import numpy as np
import pytest

from ldo_service.detection.detectors import NetworkConfig
from ldo_service.detection.labellers.dual_encoder import DualEncoderConfig, EncoderFiles
from ldo_service.detection.model_registry import Models, default_folder
from ldo_service.detection.open_networks import open_detector, open_labeller
from ldo_service.errors import ConfigError, ModelError
from tests.detection.labellers.encoders import ColorPair, embeddings, plain_image, vocabulary

from .networks import SQUARES, squares_image, squares_network

CONFIG = NetworkConfig()
ENCODERS = DualEncoderConfig()


@pytest.fixture
def models(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Models:
    monkeypatch.setenv("LDO_MODELS", str(tmp_path / "models"))
    return Models()


@pytest.fixture
def file(tmp_path: Path) -> Path:
    return SQUARES["yolox"].write(tmp_path / "squares.onnx")


def test_registered_model_is_a_copy_with_metadata(models: Models, file: Path) -> None:
    models.add("squares", file, CONFIG, license="do what you like")
    file.unlink()
    assert models.names == ["squares"]
    about = Models().get("squares").about
    assert (about.layout, about.classes) == ("yolox", ("red", "green", "blue"))
    assert (about.license, about.source) == ("do what you like", "squares.onnx")
    detector = open_detector("squares", CONFIG)
    assert len(detector.detect(squares_image([("red", 16, 48, 16)]))) == 1
    assert detector.identity == f"squares {about.sha256[:12]}"


def test_names_given_at_registration_are_kept(models: Models, tmp_path: Path) -> None:
    file = squares_network("yolov8", metadata=None).write(tmp_path / "net.onnx")
    (tmp_path / "names.txt").write_text("sofa\ncup\nglobe\n")
    models.add("mine", file, NetworkConfig(names=str(tmp_path / "names.txt"), layout="yolov8"))
    (tmp_path / "names.txt").unlink()
    detector = open_detector("mine", CONFIG)
    assert detector.names == ("sofa", "cup", "globe")
    assert detector.labels == ("couch", "cup", "globe")


def test_file_is_usable_without_registration(models: Models, file: Path) -> None:
    assert open_detector(str(file), CONFIG).identity.startswith("squares ")
    assert models.names == []


@pytest.mark.parametrize("name", ["", ".hidden", "../up", "a/b", "a b", "x" * 65])
def test_invalid_model_name_raises(models: Models, file: Path, name: str) -> None:
    with pytest.raises(ConfigError, match="not a valid model name"):
        models.add(name, file, CONFIG)


def test_duplicate_name_raises_and_keeps_its_model(models: Models, file: Path) -> None:
    models.add("one", file, CONFIG)
    other = SQUARES["yolov8"].write(file.with_name("other.onnx"))
    with pytest.raises(ConfigError, match="there is a model 'one' already"):
        models.add("one", other, CONFIG)
    assert models.get("one").about.layout == "yolox"


def test_invalid_detector_leaves_no_files(models: Models, file: Path) -> None:
    file.write_bytes(b"garbage")
    with pytest.raises(ModelError, match="no network in ONNX") as caught:
        models.add("one", file, CONFIG)
    assert ".new-" not in str(caught.value), "the message names the file of the user, not the copy"
    assert list(models.folder.iterdir()) == []


@pytest.mark.parametrize("damage", ["file", "about", "file missing"])
def test_damaged_model_raises_and_is_removable(models: Models, file: Path, damage: str) -> None:
    model = models.add("one", file, CONFIG)
    if damage == "file":
        body = bytearray(model.file.read_bytes())
        body[len(body) // 2] ^= 1
        model.file.write_bytes(body)
    elif damage == "file missing":
        model.file.unlink()
    else:
        (model.folder / "about.json").write_text(json.dumps({"sha256": 3}))
    with pytest.raises(ModelError, match="add the model again"):
        open_detector("one", CONFIG)
    models.remove("one")
    assert models.names == []


def test_unknown_name_raises_with_list_of_models(models: Models, file: Path) -> None:
    models.add("one", file, CONFIG)
    with pytest.raises(ConfigError, match="Registered models: one"):
        open_detector("two", CONFIG)
    with pytest.raises(ConfigError, match="registered: one"):
        models.remove("two")


def test_unwritable_folder_raises_with_advice(
    tmp_path: Path, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "no_folder").write_text("")
    monkeypatch.setenv("LDO_MODELS", str(tmp_path / "no_folder"))
    with pytest.raises(ConfigError, match="Set LDO_MODELS to another folder"):
        Models().add("one", file, CONFIG)
    assert Models().names == []


def test_default_folder_follows_xdg(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("LDO_MODELS", raising=False)
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert default_folder() == Path("/data/ldo/models")
    monkeypatch.delenv("XDG_DATA_HOME")
    monkeypatch.setenv("HOME", "/home/ada")
    assert default_folder() == Path("/home/ada/.local/share/ldo/models")


def test_configured_names_override_registered_names(models: Models, file, tmp_path: Path) -> None:
    models.add("one", file, CONFIG)
    (tmp_path / "names.txt").write_text("a\nb\nc\n")
    detector = open_detector("one", NetworkConfig(names=str(tmp_path / "names.txt")))
    assert detector.labels == ("a", "b", "c")
    assert np.isfinite(detector.detect(squares_image([])).scores).all()


# --- pairs of encoders ----------------------------------------------------------------------------
@pytest.fixture
def pair(tmp_path: Path) -> EncoderFiles:
    colors = ColorPair()
    return EncoderFiles(
        colors.image(tmp_path / "visual.onnx"),
        colors.text(tmp_path / "textual.onnx"),
        vocabulary(tmp_path / "merges.gz"),
    )


def test_pair_is_registered_with_all_its_files(models: Models, pair: EncoderFiles) -> None:
    about = models.add_pair("colors", pair, ENCODERS, ("Red", "sofa", "green")).about
    for file in (pair.image, pair.text, pair.vocabulary):
        assert file is not None
        file.unlink()
    assert (about.layout, about.classes) == ("clip", ("Red", "sofa", "green"))
    assert set(about.parts) == {"text.onnx", "bpe.txt.gz"}
    labeller = open_labeller("colors", ENCODERS)
    assert labeller.names == ("red", "couch", "green")
    assert labeller.label([plain_image("green")])[0][0] == "green"
    assert open_labeller("colors", ENCODERS, ("blue",)).names == ("blue",)
    assert labeller.identity == f"colors {about.sha256[:12]}"


def test_embeddings_are_registered_under_canonical_names(
    models: Models, pair: EncoderFiles, tmp_path: Path
) -> None:
    path = embeddings(tmp_path / "e.npz", names=np.array(["sofa", "green", "blue"]))
    models.add_pair("cached", EncoderFiles(pair.image, embeddings=path), ENCODERS)
    for names in ((), ("couch", "green")):
        labeller = open_labeller("cached", ENCODERS, names)
        assert labeller.label([plain_image("red")])[0][0] == "couch"


@pytest.mark.parametrize("part", ["model.onnx", "text.onnx", "bpe.txt.gz"])
def test_pair_with_a_damaged_file_raises(models: Models, pair: EncoderFiles, part: str) -> None:
    model = models.add_pair("colors", pair, ENCODERS)
    (model.folder / part).write_bytes(b"garbage")
    with pytest.raises(ModelError, match=f"{part} is not the file registered"):
        open_labeller("colors", ENCODERS)


def test_invalid_pair_leaves_no_files(models: Models, pair: EncoderFiles, tmp_path: Path) -> None:
    (tmp_path / "merges.gz").write_bytes(b"garbage")
    with pytest.raises(ModelError, match=r"merges\.gz") as caught:
        models.add_pair("colors", pair, ENCODERS)
    assert ".new-" not in str(caught.value)
    assert list(models.folder.iterdir()) == []


def test_detector_and_pair_are_not_interchangeable(
    models: Models, file: Path, pair: EncoderFiles
) -> None:
    models.add("squares", file, CONFIG)
    models.add_pair("colors", pair, ENCODERS)
    with pytest.raises(ModelError, match=r"set it as vlm_labeller\.model"):
        open_detector("colors", CONFIG)
    with pytest.raises(ModelError, match=r"set it as detector\.model"):
        open_labeller("squares", ENCODERS)
    with pytest.raises(ConfigError, match="Registered models: colors, squares"):
        open_labeller("other", ENCODERS)


def test_folder_of_a_pair_is_usable_without_registration(models: Models, tmp_path: Path) -> None:
    ColorPair().image(tmp_path / "image_encoder.onnx")
    embeddings(tmp_path / "text_embeddings.npz")
    labeller = open_labeller(str(tmp_path), ENCODERS)
    assert labeller.label([plain_image("blue")])[0][0] == "blue"
    assert models.names == []


def test_demo_networks_open_by_name(models: Models) -> None:
    detector, labeller = open_detector("demo", CONFIG), open_labeller("demo", ENCODERS)
    assert detector.layout == "yolov8"
    assert detector.identity.startswith("demo ")
    assert {"couch", "cup"} <= set(detector.names)
    assert {"couch", "radiator"} <= set(labeller.names)
    assert "wall" not in labeller.names
    assert models.names == []


def test_demo_pair_accepts_names_of_its_table_at_runtime(models: Models) -> None:
    labeller = open_labeller("demo", ENCODERS, ("lamp", "chair"))
    labeller.add("radiator")
    assert labeller.names == ("lamp", "chair", "radiator")
    with pytest.raises(ConfigError, match="no text encoder"):
        labeller.add("zebra")
    assert models.names == []


def test_name_of_demo_networks_is_reserved(models: Models, file: Path) -> None:
    with pytest.raises(ConfigError, match="choose another name"):
        models.add("demo", file, CONFIG)
