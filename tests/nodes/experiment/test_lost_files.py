"""A finished cell whose folder lost a file: the report says what to delete, and a search is not taken for whole."""

from types import SimpleNamespace

import pytest

from nodes.experiment.pages import gather
from nodes.experiment.plan.cell import Cell
from nodes.runtime.errors import RuntimeFault

CELL = Cell("track", "hardened", "gradient", 0)


@pytest.mark.parametrize("content", [None, b"", b"no attack"])
def test_a_lost_or_damaged_attack_is_answered_with_what_to_delete(tmp_path, content):
    """The cell's result says that it is done, so that another run alone changes nothing."""
    experiment = SimpleNamespace(
        cell_folder=lambda cell: tmp_path / cell.name, cell_result=lambda cell: tmp_path / f"{cell.name}.json"
    )
    (tmp_path / CELL.name).mkdir()
    if content is not None:
        (tmp_path / CELL.name / "attack.safetensors").write_bytes(content)
    result = tmp_path / f"{CELL.name}.json"
    with pytest.raises(RuntimeFault) as raised:
        list(gather._curves(experiment, CELL))
    assert "attack.safetensors" in str(raised.value)
    assert f"delete {result} and the folder {tmp_path / CELL.name}, and run the experiment again" in str(
        raised.value
    )
