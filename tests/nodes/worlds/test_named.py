"""Worlds by name: built in, a file's, an installed package's; their configuration, and what of it results depend on."""

import re
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from advnerf_core.documents import parse_yaml
from nodes.cli.main import app
from nodes.lab.plugin_tables import TABLES, rows_of
from nodes.lab.worlds.named import WORLDS, NamedWorld, read_world, without
from nodes.runtime.errors import ConfigError
from tests.support.warehouse import EXAMPLES

# A world in name only: what is asked of its class is answered, what is driven is not.
BODY = """
from dataclasses import dataclass, field
from typing import Annotated
from pydantic import BaseModel, Field

@dataclass(frozen=True)
class Lens:
    width: int = 64

@dataclass(frozen=True)
class Settings:
    seed: int = 3
    host: Annotated[str, Field(exclude=True)] = "here"
    lens: Lens = field(default_factory=Lens)

class Model(BaseModel):
    seed: int = 3
    lens: Lens = Lens()

class Yard:
    Config = Settings
    camera_pinhole = photo_pinhole = T_car_from_camera = state = blocked = None
    def __init__(self, config): self.config = config
    def describe(self): ...
    def photo_poses(self, count, rng): ...
    def reset(self, *pose): ...
    def step(self, *command): ...
    def observe(self, depth=True): ...
    def observe_at(self, *pose, depth=True): ...
    def photograph(self, T): ...
    def __enter__(self): return self
    def __exit__(self, *rest): ...

class Modelled(Yard):
    Config = Model

class Lacking:
    Config = Settings
    def __init__(self, config): ...
    def describe(self): ...

class NoConfig:
    pass

a_function = lambda config: config
"""


@pytest.fixture
def yard(tmp_path: Path) -> Path:
    (tmp_path / "yard.py").write_text(BODY)
    return tmp_path


def read(folder: Path, text: str) -> NamedWorld:
    return read_world(parse_yaml(text, "yard.experiment.yaml"), folder)


def test_the_built_in_worlds_are_what_they_are_called() -> None:
    for name, load in WORLDS.items():
        if name in ("photographs", "scene"):  # there is none without photographs, or a scene file
            continue
        world = NamedWorld(name, load(), load().Config(), "").make()
        assert world.camera_pinhole.width == 336


def test_a_file_is_named_relative_to_the_experiment(
    yard: Path, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory
) -> None:
    monkeypatch.chdir(tmp_path_factory.mktemp("elsewhere"))
    found = read(yard, "{kind: 'yard.py:Yard', seed: 5, lens: {width: 32}}")
    assert (found.config.seed, found.config.lens.width) == (5, 32)
    found.make()
    # Where the file lies changes no result, what is in it does; addresses do not.
    moved = yard / "moved"
    moved.mkdir()
    (moved / "yard.py").write_text(BODY)
    assert (
        read(moved, "{kind: 'yard.py:Yard', seed: 5, host: there, lens: {width: 32}}").settings
        == found.settings
    )
    assert read(yard, "{kind: 'yard.py:Yard'}").settings != found.settings
    (moved / "yard.py").write_text(BODY + "\n# another floor\n")
    assert read(moved, "{kind: 'yard.py:Yard', seed: 5, lens: {width: 32}}").settings != found.settings


def test_a_package_brings_a_world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "stranger_yard.py").write_text(BODY)
    info = tmp_path / "stranger_yard-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger-yard\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[advnerf.worlds]\nyard = stranger_yard:Yard\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "stranger_yard", raising=False)
    settings = read(tmp_path, "{kind: yard, seed: 4}").settings
    code = settings.pop("source_sha256")
    assert settings == {"kind": "yard", "seed": 4, "lens": {"width": 64}}
    with (tmp_path / "stranger_yard.py").open("a") as stream:
        stream.write("# edited\n")
    assert read(tmp_path, "{kind: yard, seed: 4}").settings["source_sha256"] != code
    assert [row.name for row in rows_of(TABLES["worlds"])] == [*WORLDS, "yard"]
    assert "scene" in WORLDS


@pytest.mark.parametrize(
    ("text", "told"),
    [
        (
            "kind: moon",
            r"yard\.experiment\.yaml:1: expected a world of lab, junction, carla, metadrive, duckietown, filament, photographs, scene; got 'moon'",
        ),
        ("kind: junctoin", r"did you mean junction\?"),
        ("{}", r"expected kind: NAME"),
        ("{kind: [1]}", r"expected kind: NAME"),
        (
            "kind: yard.py:Garden",
            r":1: world yard\.py:Garden: expected a name in yard\.py of .*; got 'Garden'",
        ),
        ("kind: garden.py:Yard", r"expected a Python file at .*garden\.py, found none"),
        ("kind: yard.py:NoConfig", r"expected a class with an attribute Config"),
        ("kind: yard.py:a_function", r"expected a class with an attribute Config"),
        ("kind: yard.py:Yard\nsede: 4", r":2: unknown key sede; valid keys here: host, lens, seed"),
        ("kind: yard.py:Yard\nlens:\n  heigth: 4", r":3: unknown key lens\.heigth; valid keys here: width"),
        ("kind: yard.py:Yard\nseed: many", r":2: seed: input should be a valid integer.*got 'many'"),
        (
            "kind: yard.py:Yard\nlens: 3",
            r":2: lens: expected keys and values, got 3",
        ),
        ("kind: yard.py:Modelled\nsede: 4", r":2: unknown key sede; valid keys here: lens, seed"),
        (
            "kind: yard.py:Modelled\nlens: {heigth: 4}",
            r":2: unknown key lens\.heigth; valid keys here: width",
        ),
        ("kind: junction\nroad:\n  lane: 3", r":3: unknown key road\.lane; valid keys here: corner_radius_m"),
    ],
)
def test_a_mistake_is_one_line_with_file_and_line(yard: Path, text: str, told: str) -> None:
    with pytest.raises(ConfigError, match=told) as caught:
        read(yard, text)
    assert "\n" not in str(caught.value)


def test_a_world_that_lacks_something_is_told_what(yard: Path) -> None:
    with pytest.raises(
        ConfigError,
        match=r"world yard\.py:Lacking: expected T_car_from_camera, __enter__.*photograph.* which it lacks",
    ):
        read(yard, "kind: yard.py:Lacking").make()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ("kind: junction\ncar: {speed_mps: 60}", "car.speed_mps: expected at most 50 m/s, not km/h or mm/s, got 60"),
        ("kind: junction\ncar: {body_width_m: 160}", "car.body_width_m: expected at most 20 m, not cm or mm"),
        ("kind: junction\ncar: {turn_rate_lag_s: 120}", "car.turn_rate_lag_s: expected at most 5 s, not ms"),
        ("kind: junction\ncamera: {pitch_down_rad: 8}", "camera.pitch_down_rad: expected at most 1.5708 rad, not degrees"),
        ("kind: carla\nbody: {half_width_m: 90}", "body.half_width_m: expected at most 20 m, not cm or mm"),
        ("kind: lab\ncar: {speed_mps: 800}", "car.speed_mps: expected at most 50 m/s"),
        ("kind: lab\ncar: {speed_mps: -0.8}", "car.speed_mps"),
        ("kind: lab\ncar: {wheelbase_m: 250}", "car.wheelbase_m: expected at most 20 m"),
        ("kind: scene\nfile: a\ncamera: a\nvehicle: a\nroom: a\nspeed_mps: 80", "speed_mps: expected at most 50 m/s"),
        ("kind: scene\nfile: a\ncamera: a\nvehicle: a\nroom: a\nstart: [0, 0, 90]", "as degrees that is 1.5708"),
    ],
)  # fmt: skip
def test_numbers_of_a_world_in_other_units_are_one_line(yard: Path, change: str, message: str) -> None:
    (yard / "a").touch()
    with pytest.raises(ConfigError, match=re.escape(message)) as error:
        read(yard, change)
    assert "\n" not in str(error.value)


def test_settings_without_some_keys() -> None:
    settings = {"car": {"lag": 1, "speed": 2}, "seed": 3}
    assert without(settings, ("car.lag",)) == {"car": {"speed": 2}, "seed": 3}
    assert without(settings, ("seed", "car.colour", "road.width")) == {"car": {"lag": 1, "speed": 2}}
    assert settings == {"car": {"lag": 1, "speed": 2}, "seed": 3}


def test_the_command_says_what_is_not_met(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    body = (
        (EXAMPLES / "world_warehouse.py")
        .read_text()
        .replace("target = min(max(wheel_rad,", "target = min(max(-wheel_rad,")
    )
    (tmp_path / "askew.py").write_text(body)
    monkeypatch.chdir(tmp_path)
    small = ["--set", "width=112", "--set", "height=63", "--only", "car"]
    found = CliRunner().invoke(app, ["scene", "world", "check", "askew.py:Warehouse", *small])
    assert found.exit_code == 1
    assert "not met" in found.output
    assert "on path loop it turns right" in found.output
    (tmp_path / "good.py").write_text((EXAMPLES / "world_warehouse.py").read_text())
    good = CliRunner().invoke(app, ["scene", "world", "check", "good.py:Warehouse", *small])
    assert good.exit_code == 0, good.output
    assert "not met" not in good.output
