"""docs/carla.md: its configuration is one."""

import re
from pathlib import Path

import pytest
import yaml

from hardware.worlds import CarlaConfig

ROOT = Path(__file__).parents[3]
PAGE = (ROOT / "docs" / "carla.md").read_text(encoding="utf-8")


def test_the_configuration_is_one():
    (shown,) = re.findall(r"```yaml\n(.*?)```", PAGE, re.DOTALL)
    config = CarlaConfig.model_validate(yaml.safe_load(shown))
    defaults = CarlaConfig()
    # What the page shows as the configuration are the defaults, but for the list of what is solid and a rounded angle.
    changed = {"body": defaults.body, "camera": defaults.camera}
    assert config.model_copy(update=changed) == defaults
    assert config.camera.pitch_down_rad == pytest.approx(defaults.camera.pitch_down_rad, abs=1e-3)
