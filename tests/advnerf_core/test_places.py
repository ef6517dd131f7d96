"""Without a home, with one that cannot be written, and in folders whose names are no UTF-8."""

from __future__ import annotations

import os
import pwd
import stat
import sys
from pathlib import Path

import pytest

from advnerf_core import kernel_cache, places
from advnerf_core.files import read_tensors, write_atomically
from advnerf_core.places import PlaceError, expanded, private_folder, require_utf8, user_place
from nodes.cli import main as cli

ROOT = Path(__file__).parents[2]
VARIABLES = ("HOME", "XDG_CACHE_HOME", "XDG_CONFIG_HOME", "XDG_DATA_HOME", "NUMBA_CACHE_DIR", "MPLCONFIGDIR")
LATIN1 = b"f\xe9vrier"


@pytest.fixture
def nobody(tmp_path, monkeypatch):
    """A user without a home or an entry in /etc/passwd, whose temporary files are in a folder of the test."""

    def unknown(uid):
        raise KeyError(uid)

    for name in VARIABLES:
        monkeypatch.setenv(name, "")  # noted, so that what is set meanwhile is undone
        monkeypatch.delenv(name)
    monkeypatch.setattr(pwd, "getpwuid", unknown)
    monkeypatch.setattr(places.tempfile, "gettempdir", lambda: str(tmp_path))
    return tmp_path


def test_places_are_those_of_the_environment_or_of_the_home(monkeypatch):
    for name in VARIABLES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", "/home/ann")
    assert user_place("cache") == Path("/home/ann/.cache/advnerf")
    assert user_place("config") == Path("/home/ann/.config/advnerf")
    assert user_place("data") == Path("/home/ann/.local/share/advnerf")
    monkeypatch.setenv("XDG_DATA_HOME", "/data")
    assert user_place("data") == Path("/data/advnerf")


def test_without_a_home_the_message_names_the_cure(nobody):
    with pytest.raises(PlaceError, match=r"home folder of user \d+ .* set HOME or XDG_CONFIG_HOME"):
        user_place("config")
    with pytest.raises(PlaceError, match="set HOME to a folder of this user"):
        expanded("~/world.py")
    assert expanded("/world.py") == Path("/world.py")


@pytest.fixture
def read_only(tmp_path, monkeypatch):
    """A package in a place that cannot be written; root may write everywhere, so the answer of the system is given here."""
    package = tmp_path / "installed"
    package.mkdir()
    (package / "kernels.py").write_text("from numba import njit\n")
    monkeypatch.setattr(kernel_cache, "is_writable", lambda folder: not Path(folder).is_relative_to(package))
    return package


def test_kernels_of_a_read_only_installation_go_to_a_private_folder_which_is_said_once(
    nobody, read_only, capsys
):
    folder = kernel_cache.use_own_folder(read_only)
    private = nobody / f"advnerf-{os.getuid()}"
    assert folder.is_relative_to(private)
    assert stat.S_IMODE(private.stat().st_mode) == 0o700
    (said,) = capsys.readouterr().err.splitlines()
    assert str(private) in said
    assert kernel_cache.use_own_folder(read_only) == folder
    assert capsys.readouterr().err == ""
    assert os.environ["MPLCONFIGDIR"].startswith(str(private))


def test_a_home_that_cannot_be_written_is_no_place_for_kernels(nobody, read_only, monkeypatch, capsys):
    (nobody / "home").write_text("a file")  # no folder can be made in it, not even by root
    monkeypatch.setenv("HOME", str(nobody / "home"))
    assert kernel_cache.use_own_folder(read_only).is_relative_to(nobody / f"advnerf-{os.getuid()}")
    assert str(nobody / "home") in capsys.readouterr().err


def test_a_chosen_folder_that_cannot_be_made_is_named(tmp_path, monkeypatch):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path / "file" / "kernels"))
    with pytest.raises(PlaceError, match=r"keep compiled kernels in .*; set NUMBA_CACHE_DIR"):
        kernel_cache.use_own_folder()


@pytest.mark.skipif(os.getuid() != 0, reason="only root can give a folder to another user")
def test_a_private_folder_of_another_user_or_a_link_is_refused(nobody, read_only):
    squatted = nobody / f"advnerf-{os.getuid()}"
    squatted.mkdir()
    os.chown(squatted, 4242, 4242)
    with pytest.raises(PlaceError, match="belongs to user 4242; remove it"):
        kernel_cache.use_own_folder(read_only)
    (nobody / "link").symlink_to(nobody)
    with pytest.raises(PlaceError):
        private_folder(nobody / "link")


def test_a_path_that_is_no_utf8_is_refused_before_work(tmp_path):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN1))
    folder.mkdir()
    for refuses in (
        lambda: require_utf8(folder),
        lambda: write_atomically(folder / "a", "b"),
        lambda: read_tensors(folder / "policy.safetensors", "numpy"),
    ):
        with pytest.raises(PlaceError, match=r"path in UTF-8, got b'.*f\\xe9vrier.*; rename"):
            refuses()
    require_utf8(tmp_path / "février")
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    "words",
    [
        ("scene", "train", "{data}", "-o", "{folder}/out", "--steps", "1"),
        ("experiment", "run", str(ROOT / "launch" / "room.experiment.yaml"), "--folder", "{folder}/run"),
        ("scene", "object", "build", "--generate", "hydrant", "-o", "{folder}/h.object.safetensors"),
        ("launch", str(ROOT / "launch" / "green_screen.launch.yaml"), "--folder", "{folder}/run"),
    ],
    ids=lambda words: words[0],
)
def test_commands_refuse_such_a_folder_in_one_line(tmp_path, monkeypatch, capsys, words):
    folder = Path(os.fsdecode(os.fsencode(tmp_path) + b"/" + LATIN1))
    folder.mkdir()
    filled = [word.format(folder=folder, data=tmp_path) for word in words]
    monkeypatch.setattr(sys, "argv", ["advnerf", *filled])
    monkeypatch.chdir(ROOT)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    (said,) = capsys.readouterr().err.splitlines()
    assert said.startswith("error: expected a path in UTF-8")
    assert os.listdir(folder) == []


def test_tensors_are_opened_in_one_place():
    """The library takes a path that is no UTF-8 for a damaged file."""
    files = [file for package in ("advnerf_core", "nodes") for file in (ROOT / package).rglob("*.py")]
    assert [file.name for file in files if "safe_open(" in file.read_text(encoding="utf-8")] == ["files.py"]
