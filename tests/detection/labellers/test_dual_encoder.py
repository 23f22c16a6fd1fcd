"""A pair of encoders: names by where images and texts lie."""

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

from .encoders import COLORS, SCALE, ColorPair, embeddings, plain, vocabulary

PAIR = ColorPair()


@pytest.fixture
def cached(tmp_path: Path) -> EncoderFiles:
    files = PAIR.image(tmp_path / "image.onnx"), embeddings(tmp_path / "names.npz")
    return EncoderFiles(files[0], embeddings=files[1])


@pytest.fixture
def full(tmp_path: Path) -> EncoderFiles:
    return with_text(tmp_path, PAIR)


def with_text(folder: Path, pair: ColorPair) -> EncoderFiles:
    image, text = pair.image(folder / "image.onnx"), pair.text(folder / "text.onnx")
    return EncoderFiles(image, text, vocabulary(folder / "bpe.txt.gz"))


def softmax_of_red() -> float:
    """Cosines 1, 0, 0."""
    return np.exp(SCALE) / (np.exp(SCALE) + 2)


def test_cached_names_are_told_with_the_probability_of_the_softmax(cached: EncoderFiles) -> None:
    labeller = DualEncoder(cached)
    assert labeller.names == tuple(COLORS)
    opinions = labeller.label([plain("red", 32, 32)])
    assert opinions[0] == ("red", pytest.approx(softmax_of_red()))
    assert sum(p for _, p in opinions) == pytest.approx(1)


def test_views_are_averaged(cached: EncoderFiles) -> None:
    crops = [plain(color, 32, 32) for color in ("red", "blue", "blue")]
    labeller = DualEncoder(cached)
    alone = [dict(labeller.label([crop])) for crop in crops]
    both = dict(labeller.label(crops))
    for name in COLORS:
        assert both[name] == pytest.approx(np.mean([one[name] for one in alone]))
    assert labeller.label(crops)[0][0] == "blue"
    assert labeller.label([]) == []


def test_a_crop_is_shown_whole_in_a_square_of_the_mean(tmp_path: Path) -> None:
    """A wide crop fills half of the square; the rest is the mean, which is nothing."""
    gray = (("mean", "0.5, 0.5, 0.5"), ("std", "[0.25, 0.25, 0.25]"))
    image = replace(PAIR, image_metadata=gray).image(tmp_path / "image.onnx")
    labeller = DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))
    encoder = labeller._image
    wide, square = plain("red", 20, 40), plain("red", 40, 40)
    assert encoder.embed(wide) == pytest.approx(encoder.embed(square), abs=0.02)
    assert encoder.embed(square) == pytest.approx(np.array([1, -1, -1]) / np.sqrt(3), abs=1e-5)


def test_a_text_encoder_places_any_name(full: EncoderFiles) -> None:
    labeller = DualEncoder(full, names=("red", "green"))
    assert labeller.label([plain("blue")])[0][1] == pytest.approx(0.5, abs=0.01)
    labeller.add("Blue")
    assert labeller.names == ("red", "green", "blue")
    assert labeller.label([plain("blue")])[0] == ("blue", pytest.approx(1, abs=1e-4))


def test_prompts_are_averaged_and_brought_to_length_one(full: EncoderFiles) -> None:
    prompts = ("a {}", "red {}")
    labeller = DualEncoder(full, DualEncoderConfig(prompts=prompts), names=("green",))
    labeller.label([plain("red")])
    row = labeller._rows["green"]
    expected = np.array([0.5 / np.sqrt(2), 0.5 + 0.5 / np.sqrt(2), 0])  # of (0,1,0), (1,1,0)/√2
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
def test_variants_of_the_layout_are_read(tmp_path: Path, pair: ColorPair) -> None:
    labeller = DualEncoder(with_text(tmp_path, pair), names=tuple(COLORS))
    assert labeller.label([plain("green")])[0][0] == "green"


def test_synonyms_are_one_name(full: EncoderFiles) -> None:
    labeller = DualEncoder(full, names=("sofa", "couch", "TV"))
    assert labeller.names == ("couch", "tv")


def test_nothing_competes_and_is_never_told(cached: EncoderFiles) -> None:
    labeller = DualEncoder(cached, DualEncoderConfig(nothing=("blue",)))
    assert labeller.names == ("red", "green")
    assert labeller.label([plain("blue")]) == []
    assert {name for name, _ in labeller.label([plain("red")])} == {"red", "green"}


def test_without_a_text_encoder_a_new_name_is_refused_with_what_is_missing(
    cached: EncoderFiles,
) -> None:
    labeller = DualEncoder(cached)
    with pytest.raises(ConfigError, match=r"'teapot' is not among .* --text and --vocabulary"):
        labeller.add("teapot")
    assert labeller.names == tuple(COLORS)
    with pytest.raises(ConfigError, match="'teapot'"):
        DualEncoder(cached, names=("red", "teapot"))


@pytest.mark.parametrize("name", ["", "  ", "x" * 101])
def test_what_is_no_name_is_not_added(full: EncoderFiles, name: str) -> None:
    with pytest.raises(ConfigError, match="is not a name"):
        DualEncoder(full).add(name)


def test_the_scale_of_the_file_comes_before_that_of_the_encoder(tmp_path: Path) -> None:
    image = PAIR.image(tmp_path / "image.onnx")
    npz = embeddings(tmp_path / "n.npz", logit_scale=np.float32(3))
    assert DualEncoder(EncoderFiles(image, embeddings=npz)).logit_scale == 3
    config = DualEncoderConfig(logit_scale=5)
    assert DualEncoder(EncoderFiles(image, embeddings=npz), config).logit_scale == 5
    bare = replace(PAIR, image_metadata=()).image(tmp_path / "bare.onnx")
    plain_npz = embeddings(tmp_path / "m.npz")
    assert DualEncoder(EncoderFiles(bare, embeddings=plain_npz)).logit_scale == CLIP_SCALE


def test_embeddings_may_come_in_safetensors(tmp_path: Path) -> None:
    rows = np.eye(3, dtype=np.float32)
    path = tmp_path / "names.safetensors"
    save_file({"embeddings": rows}, path, metadata={"names": "\n".join(COLORS)})
    labeller = DualEncoder(EncoderFiles(PAIR.image(tmp_path / "image.onnx"), embeddings=path))
    assert labeller.label([plain("green")])[0][0] == "green"


def test_the_same_crop_gives_the_same_bits_whatever_it_comes_with(full: EncoderFiles) -> None:
    crop = np.random.default_rng(1).integers(0, 256, (37, 21, 3), np.uint8)
    one, other = DualEncoder(full, names=tuple(COLORS)), DualEncoder(full, names=tuple(COLORS))
    other.label([plain("red"), crop])
    assert one.label([crop]) == other.label([crop])


# --- what is refused ------------------------------------------------------------------------------
def test_a_pair_of_different_dimensions_is_refused(tmp_path: Path) -> None:
    image = replace(PAIR, image_dimensions=4).image(tmp_path / "image.onnx")
    with pytest.raises(ModelError, match="4 dimensions and its texts 3"):
        DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))


@pytest.mark.parametrize(
    ("pair", "complaint"),
    [
        (replace(PAIR, channels=1), r"its inputs are pixels .* Expected: one image"),
        (replace(PAIR, image_metadata=(("mean", "grey"),)), "3 numbers are expected"),
        (replace(PAIR, image_metadata=(("std", "0,1,1"),)), "3 numbers are expected"),
    ],
)
def test_what_is_no_image_encoder_is_refused(
    tmp_path: Path, pair: ColorPair, complaint: str
) -> None:
    image = pair.image(tmp_path / "image.onnx")
    with pytest.raises(ModelError, match=complaint):
        DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))


def test_garbage_and_other_networks_are_refused(tmp_path: Path, full: EncoderFiles) -> None:
    (tmp_path / "garbage.onnx").write_text("garbage")
    with pytest.raises(ModelError, match="no network in ONNX"):
        DualEncoder(replace(full, image=tmp_path / "garbage.onnx"))
    assert full.text is not None
    with pytest.raises(ModelError, match="Expected: one image"):
        DualEncoder(replace(full, image=full.text))
    with pytest.raises(ModelError, match="Expected: tokens"):
        DualEncoder(replace(full, text=full.image))
    vocabulary(tmp_path / "large.gz", tuple(f"x {chr(ord('!') + n)}" for n in range(40)))
    with pytest.raises(ModelError, match="inference fails"):
        DualEncoder(replace(full, vocabulary=tmp_path / "large.gz"))


def test_an_encoder_that_yields_nan_is_said_to_fail(tmp_path: Path) -> None:
    image = replace(PAIR, fails_on_white=True).image(tmp_path / "image.onnx")
    labeller = DualEncoder(EncoderFiles(image, embeddings=embeddings(tmp_path / "n.npz")))
    with pytest.raises(ModelError, match="NaN"):
        labeller.label([np.full((32, 32, 3), 255, np.uint8)])
    assert labeller.label([plain("red")])[0][0] == "red"


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
def test_embeddings_that_cannot_be_are_refused(tmp_path: Path, arrays: dict) -> None:
    image = PAIR.image(tmp_path / "image.onnx")
    path = embeddings(tmp_path / "n.npz", **arrays)
    with pytest.raises(ModelError, match=r"n\.npz"):
        DualEncoder(EncoderFiles(image, embeddings=path))


def test_half_a_pair_is_refused(full: EncoderFiles) -> None:
    with pytest.raises(ConfigError, match="needs its byte pairs"):
        EncoderFiles(full.image, text=full.text)
    with pytest.raises(ConfigError, match="needs texts"):
        EncoderFiles(full.image)


@pytest.mark.parametrize(
    "fields", [{"prompts": ()}, {"prompts": ("a",)}, {"mean": (1.0,)}, {"std": (0.0, 1, 1)}]
)
def test_settings_that_cannot_be_are_refused(fields: dict) -> None:
    with pytest.raises(ConfigError, match="dual_encoder"):
        DualEncoderConfig(**fields)
