"""What an audit calls the place that it was given."""

from pathlib import Path

import pytest

from nodes.audit.places import name_of


@pytest.mark.parametrize(
    ("given", "name"),
    [("hall", "hall"), ("hall/transforms.json", "hall"), ("garage.mp4", "garage"), (".", "here")],
)
def test_a_place_is_called_as_its_folder_or_video(given, name, tmp_path, monkeypatch):
    here = tmp_path / "here"
    (here / "hall").mkdir(parents=True)
    monkeypatch.chdir(here)
    assert name_of(Path(given)) == name
