"""A changed result with an unchanged version would be taken for the old one, on every machine that has it."""

import json

import pytest

from tests.support.stage_versions import RECORDED, measured

# Between processors sums are taken in another order; a change of what is computed is larger.
_RELATIVE = 0.01


def test_what_stages_and_cells_make_is_of_their_versions(tmp_path):
    recorded, found = json.loads(RECORDED.read_text()), measured(tmp_path / "run")
    assert set(found) == set(recorded)
    for name, each in found.items():
        how = (
            f"{name}: record it with python -m tests.support.stage_versions, if that was meant, and raise its version "
            "(VERSIONS in nodes/experiment/run.py, VERSION in keys.py)"
        )
        assert each["version"] == recorded[name]["version"], how
        assert each["numbers"] == pytest.approx(recorded[name]["numbers"], rel=_RELATIVE), how
