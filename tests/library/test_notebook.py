"""The notebook in examples/ runs, and shows what its text announces."""

import base64
from pathlib import Path

import cv2
import nbformat
import numpy as np
import pytest
from nbclient import NotebookClient

NOTEBOOK = Path(__file__).parents[2] / "examples" / "library.ipynb"


@pytest.fixture(scope="module")
def executed(tmp_path_factory: pytest.TempPathFactory) -> nbformat.NotebookNode:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    folder = tmp_path_factory.mktemp("notebook")
    client = NotebookClient(notebook, timeout=300, resources={"metadata": {"path": str(folder)}})
    return client.execute()


def outputs(notebook: nbformat.NotebookNode, kind: str) -> list[str]:
    """Return the outputs of a MIME type, in order; "text" is what the cells print."""
    found = [output for cell in notebook.cells for output in cell.get("outputs", [])]
    if kind == "text":
        return [output.text for output in found if output.output_type == "stream"]
    return [output.data[kind] for output in found if kind in output.get("data", {})]


def test_notebook_tracks_all_frames_and_finds_objects(executed: nbformat.NotebookNode) -> None:
    printed = "".join(outputs(executed, "text"))
    assert "{'OK': 60, 'WEAK': 0, 'LOST': 0}" in printed
    assert "Gaussians" in printed
    assert "center [" in printed
    assert "60 poses" in printed


def test_notebook_shows_a_trajectory_and_renderings(executed: nbformat.NotebookNode) -> None:
    pictures = [
        cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
        for png in outputs(executed, "image/png")
    ]
    assert len(pictures) == 2
    for picture in pictures:
        assert picture is not None
        assert picture.std() > 10


def test_notebook_is_kept_without_outputs() -> None:
    notebook = nbformat.read(NOTEBOOK, as_version=4)
    assert outputs(notebook, "text") == outputs(notebook, "image/png") == []
