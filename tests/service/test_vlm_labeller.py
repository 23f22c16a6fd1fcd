"""A name added to a live service."""

import subprocess
from pathlib import Path

import pytest

from ldo_service.errors import ConfigError
from ldo_service.schemas import LabelNames
from ldo_service.schemas.topics import LABEL_NAMES
from tests.semantics.labellers.encoders import ColorPair, vocabulary
from tests.service.conftest import LDO, live_service, wait_until


@pytest.mark.timeout(300)
def test_a_name_is_added_while_it_runs(tmp_path: Path) -> None:
    ColorPair().image(tmp_path / "model.onnx")
    ColorPair().text(tmp_path / "text.onnx")
    vocabulary(tmp_path / "bpe.txt.gz")
    (tmp_path / "names.txt").write_text("red\n")
    use = ("--set", f"vlm_labeller.model={tmp_path}")
    use += ("--set", f"vlm_labeller.names={tmp_path / 'names.txt'}")
    with live_service(tmp_path, *use) as service:
        service.wait_for_actors()
        command = [*LDO, "control", "add-label", "fire hydrant", "--endpoint", service.endpoint]
        done = subprocess.run(command, capture_output=True, text=True)
        assert (done.returncode, "from 2 names" in done.stdout) == (0, True), done.stderr
        (last,) = service.client.last(LABEL_NAMES)
        assert isinstance(last, LabelNames)
        assert last.names == ("red", "fire hydrant")
        with pytest.raises(ConfigError, match="cannot be added: a name of 101"):
            service.client.add_label("x" * 101)

        def is_counted() -> bool:
            return service.update_health()["vlm_labeller"].facts.get("names_added") == 1

        wait_until(is_counted, 5, "counted")
        assert service.stop() == 0
        assert "Traceback" not in service.log
