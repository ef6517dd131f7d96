"""Names of users' code: built-in names, entry points, files."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from advnerf_core.plugins import (
    PluginError,
    absolute_reference,
    exit_refused,
    is_file_reference,
    known_names,
    require_known,
    resolve,
)

GROUP = "advnerf.test_things"
BUILT_IN = {"gradient": lambda: "the gradient", "random": lambda: "the random one"}


def install(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    value: str,
    body: str,
    name: str = "spiral",
    package: str = "stranger-things",
) -> None:
    """A package with one entry point, as pip leaves it behind."""
    (folder / "stranger_things.py").write_text(body)
    info = folder / f"{package.replace('-', '_')}-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {package}\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\n{name} = {value}\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "stranger_things", raising=False)


def test_a_built_in_name_is_loaded() -> None:
    assert resolve("gradient", "attack method", BUILT_IN, GROUP) == "the gradient"


def test_a_package_cannot_take_a_built_in_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, "stranger_things:SPIRAL", "raise SystemError\n", name="gradient")
    message = "gradient: expected one attack method of this name, got 2: of advnerf and of stranger-things 1.0; remove"
    with pytest.raises(PluginError, match=message):
        resolve("gradient", "attack method", BUILT_IN, GROUP)
    with pytest.raises(PluginError, match=message):
        require_known("gradient", "attack method", BUILT_IN, GROUP)
    assert resolve("random", "attack method", BUILT_IN, GROUP) == "the random one"
    assert known_names(BUILT_IN, GROUP) == ("gradient", "random")


def test_two_packages_cannot_have_one_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for package in ("stranger-things", "other-things"):
        install(tmp_path, monkeypatch, "stranger_things:SPIRAL", "raise SystemError\n", package=package)
    with pytest.raises(
        PluginError,
        match=r"spiral: expected one .* got 2: of (other-things 1.0 and of stranger|stranger-things 1.0 and of other)-things 1.0",
    ):
        resolve("spiral", "attack method", BUILT_IN, GROUP)


def test_an_unknown_name_gets_the_valid_ones_and_the_nearest() -> None:
    with pytest.raises(
        PluginError,
        match=r"expected an attack method of gradient, random; got 'gradiant' \(did you mean gradient\?\)",
    ):
        resolve("gradiant", "attack method", BUILT_IN, GROUP)


def test_an_entry_point_of_an_installed_package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, "stranger_things:SPIRAL", "SPIRAL = 'a spiral'\n")
    assert resolve("spiral", "attack method", BUILT_IN, GROUP) == "a spiral"
    assert known_names(BUILT_IN, GROUP) == ("gradient", "random", "spiral")


def test_a_broken_package_harms_only_its_own_name(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    install(tmp_path, monkeypatch, "stranger_things:SPIRAL", "import a_package_that_is_not_there\n")
    assert resolve("random", "attack method", BUILT_IN, GROUP) == "the random one"
    with pytest.raises(
        PluginError,
        match=r"spiral: stranger_things:SPIRAL of stranger-things cannot be loaded: ModuleNotFoundError",
    ):
        resolve("spiral", "attack method", BUILT_IN, GROUP)


def test_a_file_is_loaded_from_its_folder_and_again_when_it_changes(tmp_path: Path) -> None:
    (tmp_path / "mine.py").write_text("class Mine:\n    number = 1\n")
    first = resolve("mine.py:Mine", "world", {}, GROUP, tmp_path)
    assert first.number == 1
    assert resolve("mine.py:Mine", "world", {}, GROUP, tmp_path) is first
    (tmp_path / "mine.py").write_text("class Mine:\n    number = 2\n")
    assert resolve("mine.py:Mine", "world", {}, GROUP, tmp_path).number == 2


@pytest.mark.parametrize(
    ("body", "name", "message"),
    [
        (None, "mine.py:Mine", "expected a Python file at"),
        ("raise SystemExit(0)\n", "mine.py:Mine", "cannot be loaded: SystemExit: 0"),
        ("x = 1 / 0\n", "mine.py:Mine", "cannot be loaded: ZeroDivisionError: division by zero"),
        (
            "import torch\ntorch.set_default_dtype(torch.float64)\nMine = 1\n",
            "mine.py:Mine",
            r"cannot be loaded: PluginError: expected torch's default dtype as it was, torch.float32, got torch.float64",
        ),
        (
            "import torch\ntorch.set_grad_enabled(False)\nMine = 1\n",
            "mine.py:Mine",
            r"recording of gradients as it was, on, got off.*with torch.no_grad",
        ),
        (
            "Mime = 1\n",
            "mine.py:Mine",
            r"expected a name in mine.py of Mime; got 'Mine' \(did you mean Mime\?\)",
        ),
    ],
)
def test_a_file_that_does_not_do_is_one_line(
    tmp_path: Path, body: str | None, name: str, message: str
) -> None:
    if body is not None:
        (tmp_path / "mine.py").write_text(body)
    with pytest.raises(PluginError, match=message) as caught:
        resolve(name, "world", {}, GROUP, tmp_path)
    assert "\n" not in str(caught.value)


def test_a_user_s_code_does_not_end_a_command_as_if_all_were_well() -> None:
    for asked in (None, 0, 1, 3, "no weights"):
        with pytest.raises(PluginError, match=r"to return, it has called sys\.exit"), exit_refused():
            sys.exit(asked)
    with pytest.raises(SystemExit, match="143"), exit_refused():  # asked to end by a signal
        sys.exit(143)


def test_references_become_absolute_for_workers(tmp_path: Path) -> None:
    assert absolute_reference("mine.py:Mine", tmp_path) == f"{tmp_path / 'mine.py'}:Mine"
    assert absolute_reference("junction", tmp_path) == "junction"
    assert not is_file_reference("package.module:factory")
