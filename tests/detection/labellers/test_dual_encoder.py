"""Dual encoder: labels from the similarity of image and text embeddings."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from onnx import TensorProto
from safetensors.numpy import save_file

from ldo_service.detection.labellers.dual_encoder import (
    CLIP_SCALE,
    DualEncoder,
    DualEncoderConfig,
    EncoderFiles,
)
from ldo_service.errors import ConfigError, ModelError

from .encoders import COLORS, SCALE, ColorPair, embeddings, plain_image, vocabulary

PAIR = ColorPair()


@pytest.fixture
def cached_files(tmp_path: Path) -> EncoderFiles:
    files = PAIR.image(tmp_path / "image.onnx"), embeddings(tmp_path / "names.npz")
    return EncoderFiles(files[0], embeddings=files[1])


@pytest.fixture
def full_files(tmp_path: Path) -> EncoderFiles:
    return with_text(tmp_path, PAIR)


def with_text(folder: Path, pair: ColorPair) -> EncoderFiles:
    image, text = pair.image(folder / "image.onnx"), pair.text(folder / "text.onnx")
    return EncoderFiles(image, text, vocabulary(folder / "bpe.txt.gz"))


def softmax_of_red() -> float:
    """Return the softmax probability of red for the cosines 1, 0, 0."""
    return np.exp(SCALE) / (np.exp(SCALE) + 2)


def test_cached_names_have_softmax_probabilities(cached_files: EncoderFiles) -> None:
    labeller = DualEncoder(cached_files)
    assert labeller.names == tuple(COLORS)
    labels = labeller.label([plain_image("red", 32, 32)])
    assert labels[0] == ("red", pytest.approx(softmax_of_red()))
    assert sum(p for _, p in labels) == pytest.approx(1)


def test_probabilities_of_views_are_averaged(cached_files: EncoderFiles) -> None:
    crops = [plain_image(color, 32, 32) for color in ("red", "blue", "blue")]
    labeller = DualEncoder(cached_files)
    alone = [dict(labeller.label([crop])) for crop in crops]
    fused = dict(labeller.label(crops))
    for name in COLORS:
        assert fused[name] == pytest.approx(np.mean([one[name] for one in alone]))
    assert labeller.label(crops)[0][0] == "blue"
    assert labeller.label([]) == []


def test_crop_is_padded_to_a_square_with_the_mean_color(tmp_path: Path) -> None:
    """A wide crop fills half of the square; the rest has the mean color, which embeds to zero."""
    gray = (("mean", "0.5, 0.5, 0.5"), ("std", "[0.25, 0.25, 0.25]"))
    image = replace(PAIR, image_metadata=gray).image(tmp_path / "image.onnx")
    labeller = DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))
    encoder = labeller._image
    wide, square = plain_image("red", 20, 40), plain_image("red", 40, 40)
    assert encoder.embed(wide) == pytest.approx(encoder.embed(square), abs=0.02)
    assert encoder.embed(square) == pytest.approx(np.array([1, -1, -1]) / np.sqrt(3), abs=1e-5)


def test_text_encoder_embeds_new_names(full_files: EncoderFiles) -> None:
    labeller = DualEncoder(full_files, names=("red", "green"))
    assert labeller.label([plain_image("blue")])[0][1] == pytest.approx(0.5, abs=0.01)
    labeller.add("Blue")
    assert labeller.names == ("red", "green", "blue")
    assert labeller.label([plain_image("blue")])[0] == ("blue", pytest.approx(1, abs=1e-4))


def test_prompt_embeddings_are_averaged_and_normalized(full_files: EncoderFiles) -> None:
    prompts = ("a {}", "red {}")
    labeller = DualEncoder(full_files, DualEncoderConfig(prompts=prompts), names=("green",))
    labeller.label([plain_image("red")])
    row = labeller._rows["green"]
    # Mean of (0, 1, 0) and (1, 1, 0) / √2.
    expected = np.array([0.5 / np.sqrt(2), 0.5 + 0.5 / np.sqrt(2), 0])
    assert row == pytest.approx(expected / np.linalg.norm(expected), abs=0.02)


@pytest.mark.parametrize(
    "pair",
    [
        replace(PAIR, has_hidden_state=False, has_mask=False),
        replace(PAIR, integer=TensorProto.INT32),
        replace(PAIR, side="side"),
    ],
    ids=["plain", "int32", "any side"],
)
def test_encoder_variants_are_supported(tmp_path: Path, pair: ColorPair) -> None:
    labeller = DualEncoder(with_text(tmp_path, pair), names=tuple(COLORS))
    assert labeller.label([plain_image("green")])[0][0] == "green"


def test_synonyms_become_one_name(full_files: EncoderFiles) -> None:
    labeller = DualEncoder(full_files, names=("sofa", "couch", "TV"))
    assert labeller.names == ("couch", "tv")


def test_background_names_compete_but_are_never_returned(cached_files: EncoderFiles) -> None:
    labeller = DualEncoder(cached_files, DualEncoderConfig(nothing=("blue",)))
    assert labeller.names == ("red", "green")
    assert labeller.label([plain_image("blue")]) == []
    assert {name for name, _ in labeller.label([plain_image("red")])} == {"red", "green"}


def test_new_name_without_text_encoder_raises_with_advice(
    cached_files: EncoderFiles,
) -> None:
    labeller = DualEncoder(cached_files)
    with pytest.raises(ConfigError, match=r"'teapot' has no stored .* with --text .* --vocabulary"):
        labeller.add("teapot")
    assert labeller.names == tuple(COLORS)
    with pytest.raises(ConfigError, match="'teapot'"):
        DualEncoder(cached_files, names=("red", "teapot"))


@pytest.mark.parametrize("name", ["", "  ", "x" * 101])
def test_invalid_name_raises_config_error(full_files: EncoderFiles, name: str) -> None:
    with pytest.raises(ConfigError, match="is not a name"):
        DualEncoder(full_files).add(name)


def test_logit_scale_of_config_and_embeddings_take_precedence(tmp_path: Path) -> None:
    image = PAIR.image(tmp_path / "image.onnx")
    npz = embeddings(tmp_path / "n.npz", logit_scale=np.float32(3))
    assert DualEncoder(EncoderFiles(image, embeddings=npz)).logit_scale == 3
    config = DualEncoderConfig(logit_scale=5)
    assert DualEncoder(EncoderFiles(image, embeddings=npz), config).logit_scale == 5
    bare = replace(PAIR, image_metadata=()).image(tmp_path / "bare.onnx")
    plain_npz = embeddings(tmp_path / "m.npz")
    assert DualEncoder(EncoderFiles(bare, embeddings=plain_npz)).logit_scale == CLIP_SCALE


def test_embeddings_are_read_from_safetensors(tmp_path: Path) -> None:
    rows = np.eye(3, dtype=np.float32)
    path = tmp_path / "names.safetensors"
    save_file({"embeddings": rows}, path, metadata={"names": "\n".join(COLORS)})
    labeller = DualEncoder(EncoderFiles(PAIR.image(tmp_path / "image.onnx"), embeddings=path))
    assert labeller.label([plain_image("green")])[0][0] == "green"


def test_label_is_bitwise_equal_after_other_crops(full_files: EncoderFiles) -> None:
    crop = np.random.default_rng(1).integers(0, 256, (37, 21, 3), np.uint8)
    one, other = (DualEncoder(full_files, names=tuple(COLORS)) for _ in range(2))
    other.label([plain_image("red"), crop])
    assert one.label([crop]) == other.label([crop])


# --- invalid files and settings -------------------------------------------------------------------
def test_mismatched_embedding_dimensions_raise(tmp_path: Path) -> None:
    image = replace(PAIR, image_dimensions=4).image(tmp_path / "image.onnx")
    with pytest.raises(ModelError, match="4 dimensions and its text embeddings 3"):
        DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))


@pytest.mark.parametrize(
    ("pair", "message"),
    [
        (replace(PAIR, channels=1), r"inputs are pixels .* Expected: one image"),
        (replace(PAIR, image_metadata=(("mean", "gray"),)), "Expected: 3 finite numbers"),
        (replace(PAIR, image_metadata=(("std", "0,1,1"),)), "Expected: 3 finite numbers"),
    ],
)
def test_invalid_image_encoder_raises(tmp_path: Path, pair: ColorPair, message: str) -> None:
    image = pair.image(tmp_path / "image.onnx")
    with pytest.raises(ModelError, match=message):
        DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))


def test_invalid_and_swapped_files_raise(tmp_path: Path, full_files: EncoderFiles) -> None:
    (tmp_path / "garbage.onnx").write_text("garbage")
    with pytest.raises(ModelError, match="no network in ONNX"):
        DualEncoder(replace(full_files, image=tmp_path / "garbage.onnx"))
    assert full_files.text is not None
    with pytest.raises(ModelError, match="Expected: one image"):
        DualEncoder(replace(full_files, image=full_files.text))
    with pytest.raises(ModelError, match="Expected: tokens"):
        DualEncoder(replace(full_files, text=full_files.image))
    vocabulary(tmp_path / "large.gz", tuple(f"x {chr(ord('!') + n)}" for n in range(40)))
    with pytest.raises(ModelError, match="inference of the network fails"):
        DualEncoder(replace(full_files, vocabulary=tmp_path / "large.gz"))


def test_nan_embedding_raises(tmp_path: Path) -> None:
    image = replace(PAIR, fails_on_white=True).image(tmp_path / "image.onnx")
    labeller = DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))
    with pytest.raises(ModelError, match="NaN"):
        labeller.label([np.full((32, 32, 3), 255, np.uint8)])
    assert labeller.label([plain_image("red")])[0][0] == "red"


@pytest.mark.parametrize(
    "arrays",
    [
        {"embeddings": np.eye(2, dtype=np.float32)},
        {"embeddings": np.zeros((3, 3), np.float32)},
        {"embeddings": np.full((3, 3), np.nan, np.float32)},
        {"names": np.array(["a", "", "c"])},
        {"logit_scale": np.array([-1.0])},
        {"names": np.array([{}, {}, {}], object)},
    ],
    ids=["too few", "zeros", "nan", "no name", "scale", "pickle"],
)
def test_invalid_embeddings_raise(tmp_path: Path, arrays: dict) -> None:
    image = PAIR.image(tmp_path / "image.onnx")
    path = embeddings(tmp_path / "n.npz", **arrays)
    with pytest.raises(ModelError, match=r"n\.npz"):
        DualEncoder(EncoderFiles(image, embeddings=path))


def test_incomplete_pair_raises_config_error(full_files: EncoderFiles) -> None:
    with pytest.raises(ConfigError, match="needs its byte pairs"):
        EncoderFiles(full_files.image, text=full_files.text)
    with pytest.raises(ConfigError, match="needs text embeddings"):
        EncoderFiles(full_files.image)


@pytest.mark.parametrize(
    "fields", [{"prompts": ()}, {"prompts": ("a",)}, {"mean": (1.0,)}, {"std": (0.0, 1, 1)}]
)
def test_invalid_settings_raise_config_error(fields: dict) -> None:
    with pytest.raises(ConfigError, match="dual_encoder"):
        DualEncoderConfig(**fields)
