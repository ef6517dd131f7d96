"""docs/carla.md: its configuration is one, and its program runs."""

import re
from pathlib import Path

import pytest
import yaml

from hardware.worlds.carla import CarlaConfig, CarlaScene

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "carla.md").read_text(encoding="utf-8")


def block(language):
    (found,) = re.findall(rf"```{language}\n(.*?)```", PAGE, re.DOTALL)
    return found


def test_the_configuration_is_one():
    config = CarlaConfig.model_validate(yaml.safe_load(block("yaml")))
    defaults = CarlaConfig()
    # What the page shows as the configuration are the defaults, but for the list of what is solid and a rounded angle.
    changed = {"body": defaults.body, "camera": defaults.camera}
    assert config.model_copy(update=changed) == defaults
    assert config.camera.pitch_down_rad == pytest.approx(defaults.camera.pitch_down_rad, abs=1e-3)


def test_the_program_runs(library, settings, monkeypatch):
    config = CarlaConfig.model_validate(settings)
    monkeypatch.setattr("hardware.worlds.carla.CarlaConfig", lambda: config)
    monkeypatch.setattr("hardware.worlds.carla.CarlaScene", lambda given: CarlaScene(given, library))
    names = {}
    exec(compile(block("python"), "docs/carla.md", "exec"), names)
    assert names["depth"].shape == names["rgb"].shape[:2] == (46, 84)
    assert not library.world.actors
