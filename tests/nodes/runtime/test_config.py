import os
import tempfile
from pathlib import Path

import pytest
import yaml
from pydantic import BaseModel, ConfigDict, Field

from advnerf_core.documents import parse_yaml
from advnerf_core.places import PlaceError, private_folder
from nodes.launching.launch_file import load_launch
from nodes.runtime.config import (
    apply_overrides,
    key_and_value,
    load_config,
    load_node_config,
    node_document,
    typed_values,
)
from nodes.runtime.errors import BusError, ConfigError
from nodes.runtime.paths import bus_folder, named_file, shipped, user_folder

pytestmark = pytest.mark.live


class Lens(BaseModel):
    model_config = ConfigDict(extra="forbid")
    fov_deg: float = Field(default=90.0, gt=0, lt=180)


class Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")
    name: str
    rate_hz: float = 10.0
    lens: Lens = Lens()
    spares: list[Lens] = []
    by_name: dict[str, Lens] = {}
    maybe: Lens | None = None


def write(tmp_path, text):
    path = tmp_path / "camera.yaml"
    path.write_text(text)
    return path


def test_values_and_overrides(tmp_path):
    path = write(tmp_path, "name: front\nlens:\n  fov_deg: 80\n")
    camera = load_config(Camera, path, ["rate_hz=5", "lens.fov_deg=70", "by_name.wide.fov_deg=120"])
    assert (camera.name, camera.rate_hz, camera.lens.fov_deg, camera.by_name["wide"].fov_deg) == (
        "front",
        5,
        70,
        120,
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "name: a\nrat_hz: 3\n",
            r":2: unknown key rat_hz; valid keys here: by_name, lens, maybe, name, rate_hz, spares",
        ),
        ("name: a\nlens:\n  fov: 3\n", r":3: unknown key lens\.fov; valid keys here: fov_deg"),
        (
            "name: a\nspares:\n- fov_deg: 3\n- fov: 3\n",
            r":4: unknown key spares\.1\.fov; valid keys here: fov_deg",
        ),
        (
            "name: a\nby_name:\n  wide:\n    fov: 3\n",
            r":4: unknown key by_name\.wide\.fov; valid keys here: fov_deg",
        ),
        ("name: a\nmaybe:\n  fov: 3\n", r":3: unknown key maybe\.fov; valid keys here: fov_deg"),
        ("name: a\nlens: {fov_deg: 200}\n", r":2: lens\.fov_deg: input should be less than 180, got 200"),
        ("rate_hz: 3\n", r":1: name is missing"),
        ("name: a\nname: b\n", r":2: name is given twice"),
        ("name: [a\n", r":\d: expected valid YAML"),
        ("name: !!python/object/apply:os.getcwd []\n", r":1: expected valid YAML"),
        ("- a\n", r":1: expected keys and values, got list"),
        ("", r": name is missing"),
    ],
)
def test_mistake_names_file_line_and_valid_keys(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ConfigError, match=r"camera\.yaml" + message) as caught:
        load_config(Camera, path)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("nothing", ["", "null", "~", " null "])
def test_an_override_can_say_none(nothing):
    document = parse_yaml("{name: front, maybe: {fov_deg: 60}}", "camera.yaml")
    apply_overrides(document, [f"maybe={nothing}"])
    assert document.data["maybe"] is None


def test_missing_file_is_a_config_error(tmp_path):
    with pytest.raises(ConfigError, match="expected a file, found none"):
        load_config(Camera, tmp_path / "nothing.yaml")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("rate_hz", "expected KEY=VALUE"),
        ("=3", "expected KEY=VALUE"),
        ("name.x=3", "expected a section above 'x', got a value without keys"),
        ("name.x.y=3", "got a value without keys"),
        ("rate_hz=[", "--set rate_hz=\\[:1: expected valid YAML"),
        ("rate_hz=fast", "--set rate_hz=fast: rate_hz: input should be a valid number"),
        ("rate=1", "--set rate=1: unknown key rate; valid keys"),
    ],
)
def test_wrong_override_names_itself(tmp_path, override, message):
    with pytest.raises(ConfigError, match=message):
        load_config(Camera, write(tmp_path, "name: a\n"), [override])


def test_values_by_name_are_yaml_and_a_text_without_a_name_says_the_form():
    assert typed_values("--declare", ["a= [1, 2]", "b=null", " c =x=y"], "a=1") == {
        "a": [1, 2],
        "b": None,
        "c": "x=y",
    }
    for text in ("a", "=1"):
        with pytest.raises(
            ConfigError, match=f"--declare {text}: expected KEY=VALUE, for example --declare a=1"
        ):
            typed_values("--declare", [text], "a=1")
    assert key_and_value("--remap", "/a:=/b", "/a:=/b", "OLD:=NEW", ":=") == ("/a", "/b")
    with pytest.raises(ConfigError, match=r"--attack none=: expected CONDITION=FILE"):
        key_and_value("--attack", "none=", "a=b", "CONDITION=FILE", needs_value=True)


LAUNCH = "nodes:\n  cam:\n    config:\n      name: a\n      rat: 3\n"


def test_copy_for_a_node_still_names_the_file_of_the_user(tmp_path):
    part = parse_yaml(LAUNCH, "my.launch.yaml").part(("nodes", "cam", "config"))
    path = write(tmp_path, yaml.safe_dump(node_document(part)))
    with pytest.raises(ConfigError, match=r"^my\.launch\.yaml:5: unknown key rat; valid keys here: by_name"):
        load_node_config(Camera, "cam", path)


def test_copy_for_a_node_still_names_the_override(tmp_path):
    document = parse_yaml(LAUNCH.replace("rat:", "rate_hz:"), "my.launch.yaml")
    apply_overrides(document, ["nodes.cam.config.lens.fov=3"])
    path = write(tmp_path, yaml.safe_dump(node_document(document.part(("nodes", "cam", "config")))))
    with pytest.raises(ConfigError, match=r"^--set nodes\.cam\.config\.lens\.fov=3: unknown key lens\.fov"):
        load_node_config(Camera, "cam", path)


def test_node_without_a_file_takes_its_defaults():
    assert load_node_config(Lens, "lens", None).fov_deg == 90
    with pytest.raises(ConfigError, match="defaults of cam: name is missing"):
        load_node_config(Camera, "cam", None)


def test_socket_folder_is_private_and_short(tmp_path, monkeypatch):
    folder = bus_folder(tmp_path / "run")
    assert folder.stat().st_mode & 0o777 == 0o700
    with tempfile.TemporaryDirectory(dir="/tmp") as short_base:
        monkeypatch.setenv("XDG_RUNTIME_DIR", short_base)
        deep = bus_folder(tmp_path / ("x" * 100))
        assert deep.parent == user_folder() == Path(short_base) / "advnerf"
        assert deep == bus_folder(tmp_path / ("x" * 100))
    long_base = tmp_path / ("y" * 90)
    long_base.mkdir()
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(long_base))
    with pytest.raises(BusError, match=r"at most 107 characters.*--folder under /tmp"):
        bus_folder(tmp_path / ("x" * 100))


def test_folder_of_somebody_else_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(os, "getuid", lambda: 12345)
    with pytest.raises(PlaceError, match=r"expected .* to belong to user 12345"):
        private_folder(tmp_path / "bus")


def test_a_file_is_named_by_its_path_or_by_its_name_here_before_what_is_shipped(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert named_file("green_screen", "launch") == shipped("launch/green_screen.launch.yaml")
    assert named_file("room", "experiment") == shipped("launch/room.experiment.yaml")
    (tmp_path / "launch").mkdir()
    for name in ("green_screen", "mine"):
        (tmp_path / "launch" / f"{name}.launch.yaml").touch()
        assert named_file(name, "launch") == Path("launch") / f"{name}.launch.yaml"
    (tmp_path / "mine").touch()
    assert named_file("mine", "launch") == Path("mine")
    for wrong in ("launch/monitor.launch.yaml", "mones", "../green_screen"):
        with pytest.raises(
            PlaceError, match=rf"none at {wrong}.* green_screen, mine, monitor, .*advnerf experiment init"
        ):
            named_file(wrong, "launch")


def test_launch_files_find_the_calibration_of_the_simulated_lab_from_any_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    plan = load_launch(named_file("green_screen", "launch"))
    camera = Path(plan.documents["camera"].data["calibration"])
    assert camera == shipped("calibration/twin/camera.yaml")
    assert camera.is_file()
    told = load_launch(named_file("green_screen", "launch"), twin_calibration="calibration/twin").resolved
    assert str(tmp_path) not in str(told)
    assert str(shipped("calibration")) not in str(told)  # so that its digest is the same on every machine
