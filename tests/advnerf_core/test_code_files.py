"""Users' code: hashes of plug-ins with the modules beside them, of installed packages, of modules of policies; lines of errors."""

from __future__ import annotations

import ast
import gc
import sys
from hashlib import sha256
from importlib.machinery import EXTENSION_SUFFIXES
from pathlib import Path
from types import ModuleType

import pytest

from advnerf_core import code_files
from advnerf_core.code_files import file_sha256, module_sha256, modules_beside, was_raised_by_a_user
from advnerf_core.files import sha256_of
from advnerf_core.plugins import PluginError, code_sha256, in_one_line, load_from_file, resolve

GROUP = "advnerf.test_things"


def write(folder: Path, **files: str) -> Path:
    """Python files by dotted name; the folder."""
    for name, text in files.items():
        file = folder / (name.replace("__", "/") + ".py")
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_text(text)
    return folder


def names(folder: Path, files: list[Path]) -> list[str]:
    return [file.relative_to(folder).as_posix() for file in files]


def test_a_file_counts_with_the_modules_beside_it_that_it_imports(tmp_path: Path) -> None:
    write(
        tmp_path,
        mine="import numpy, one\nfrom pack.inner import x\nMine = 1\n",
        one="def late():\n    import two\n",
        two="import one, mine  # round and round\n",
        pack__inner="x = 1\n",
        pack__other="y = 1\n",
        unrelated="z = 1\n",
        nodes="not_ours = 'ours is a package'\n",
    )
    found = modules_beside(tmp_path / "mine.py")
    assert names(tmp_path, found) == ["one.py", "pack/inner.py", "pack/other.py", "two.py"]
    for name in ("one", "two", "pack/other", "unrelated"):
        before = file_sha256(tmp_path / "mine.py")
        with (tmp_path / f"{name}.py").open("a") as stream:
            stream.write("# edited\n")
        assert (file_sha256(tmp_path / "mine.py") == before) == (name == "unrelated")


def test_a_file_that_imports_nothing_beside_it_is_named_by_its_bytes(tmp_path: Path) -> None:
    file = write(tmp_path, mine="import numpy\nMine = 1\n", other="") / "mine.py"
    assert file_sha256(file) == sha256_of(file) == code_sha256("mine.py:Mine", (), GROUP, tmp_path)
    file.write_text("import (\n")  # loading it says what is wrong
    assert file_sha256(file) == sha256_of(file)


def test_a_file_imports_what_is_beside_it_as_it_is_now(tmp_path: Path) -> None:
    a = write(tmp_path / "a", mine="import helper, hardware\nMine = helper.x\n", helper="x = 'a1'\n")
    write(a, hardware="1 / 0\n")  # ours is meant
    b = write(tmp_path / "b", mine="from helper import x as Mine\n", helper="x = 'b1'\n")
    finders, modules = [*sys.meta_path], {*sys.modules}
    assert load_from_file(f"{a}/mine.py:Mine", "thing") == "a1"
    assert load_from_file(f"{b}/mine.py:Mine", "thing") == "b1"
    write(a, helper="x = 'a2'\n")  # as long as before, within the same second
    assert load_from_file(f"{a}/mine.py:Mine", "thing") == "a2"
    assert load_from_file(f"{b}/mine.py:Mine", "thing") == "b1"
    assert sys.meta_path == finders
    assert "helper" not in {*sys.modules} - modules
    assert not list(tmp_path.rglob("*.pyc"))


def test_a_helper_that_fails_is_one_line_and_leaves_nothing_behind(tmp_path: Path) -> None:
    write(tmp_path, mine="import helper\nMine = 1\n", helper="1 / 0\n")
    finders = [*sys.meta_path]
    with pytest.raises(PluginError, match=r"mine\.py cannot be loaded: ZeroDivisionError: division by zero"):
        load_from_file(f"{tmp_path}/mine.py:Mine", "thing")
    assert sys.meta_path == finders
    assert "helper" not in sys.modules


@pytest.mark.parametrize("packed", [True, False])
def test_an_edited_package_is_another_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, packed: bool
) -> None:
    top = "stranger_pack" if packed else "stranger_flat"
    inner = f"{top}__inner" if packed else top
    write(tmp_path, **{inner: "Thing = 'first'\n"}, **({f"{top}____init__": ""} if packed else {}))
    info = tmp_path / "stranger-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[{GROUP}]\nthing = {inner.replace('__', '.')}:Thing\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    assert resolve("thing", "thing", {}, GROUP) == "first"
    before = code_sha256("thing", (), GROUP)
    (tmp_path / "notes.txt").write_text("of another package")
    assert code_sha256("thing", (), GROUP) == before
    write(tmp_path, **{inner: "Thing = 'other'\n"})
    edited = code_sha256("thing", (), GROUP)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger\nVersion: 1.1\n")
    assert len({before, edited, code_sha256("thing", (), GROUP)}) == 3
    if packed:
        data = tmp_path / top / "table.csv"
        data.write_text("1\n")
        with_data = code_sha256("thing", (), GROUP)
        data.write_text("2\n")
        assert len({edited, with_data, code_sha256("thing", (), GROUP)}) == 3
    assert code_sha256("thing", ("thing",), GROUP) == code_sha256("no_thing", (), GROUP) == ""


def test_versions_of_imported_packages_count(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write(tmp_path, my_net="import a_stranger\nimport json\n", a_stranger="", another="")
    for module in ("a_stranger", "another"):
        info = tmp_path / f"{module}-1.0.dist-info"
        info.mkdir()
        (info / "top_level.txt").write_text(module)
    folder = write(tmp_path / "own", my_net="import a_stranger\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.syspath_prepend(str(folder))
    found = []
    for versions in (("1.0", "1.0"), ("1.0", "2.0"), ("1.0+cpu", "1.0"), ("1.1", "1.0")):
        for module, version in zip(("a_stranger", "another"), versions, strict=True):
            text = f"Metadata-Version: 2.1\nName: {module}\nVersion: {version}\n"
            (tmp_path / f"{module}-1.0.dist-info" / "METADATA").write_text(text)
        code_files._packages_by_module.cache_clear()
        found.append(module_sha256("my_net"))
    code_files._packages_by_module.cache_clear()
    assert found[0] == found[1] == found[2] != found[3]


def test_a_module_without_files_has_no_hash(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    in_memory = "a_module_in_memory"
    monkeypatch.setitem(sys.modules, in_memory, ModuleType(in_memory))
    (tmp_path / "a_folder_without_files").mkdir()
    monkeypatch.syspath_prepend(str(tmp_path))
    for module in (in_memory, "sys", "a_module_that_is_not_there", "a_folder_without_files"):
        with pytest.raises(ImportError, match=f"found no file of a module {module}"):
            module_sha256(module)


def test_a_compiled_module_counts(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    file = tmp_path / f"a_compiled_module{EXTENSION_SUFFIXES[0]}"
    monkeypatch.syspath_prepend(str(tmp_path))
    found = []
    for content in (b"one", b"two"):
        file.write_bytes(content)
        found.append(module_sha256("a_compiled_module"))
    assert len({*found, sha256().hexdigest()}) == 3


def test_an_error_of_a_users_code_names_the_line_that_called_the_library(tmp_path: Path) -> None:
    folder = write(
        tmp_path,
        helper="import json\n\n\ndef read(text):\n    return json.loads(text)\n",
        mine="import helper\n\n\ndef Mine(text):\n    return helper.read(text)\n",
    )
    mine = load_from_file(f"{folder / 'mine.py'}:Mine", "thing")
    with pytest.raises(ValueError) as error:
        mine("no JSON")
    assert in_one_line(error.value) == (
        f"JSONDecodeError: Expecting value: line 1 column 1 (char 0) ({folder / 'helper.py'}:5)"
    )
    with pytest.raises(PluginError) as refused:
        load_from_file(f"{folder / 'mine.py'}:Other", "thing")
    assert ".py:" not in in_one_line(refused.value).replace("mine.py:Other", "")


def test_whose_error_it_is_is_told_by_the_innermost_code(tmp_path: Path) -> None:
    theirs, asked = tmp_path / "theirs.py", "import json\nfrom advnerf_core.files import sha256_of\n"
    theirs.write_text(
        asked
        + "def own(): raise RuntimeError('x')\ndef library(): json.loads('{')\ndef ours(): sha256_of(None)\n"
    )
    for name, blamed in (("own", True), ("library", True), ("ours", False)):
        with pytest.raises(Exception) as raised:
            load_from_file(f"{theirs}:{name}", "code")()
        assert was_raised_by_a_user(raised.value) is blamed


class Parses:
    """Garbage that parses when it is collected, as another thread may at that moment."""

    def __init__(self) -> None:
        self.me = self

    def __del__(self) -> None:
        ast.parse("x = (1 + (2 * (3 + 4)))")


def test_a_parse_during_a_parse_is_no_fault_of_the_file(tmp_path: Path) -> None:
    """CPython before 3.13 then raises a SystemError (python/cpython#106905)."""
    write(tmp_path, mine=Path(code_files.__file__).read_text() + "\nimport two\n", two="x = 1\n")
    thresholds = gc.get_threshold()
    gc.set_threshold(50, 5, 5)
    try:
        for _ in range(20):
            for _ in range(5):
                Parses()
            assert names(tmp_path, modules_beside(tmp_path / "mine.py")) == ["two.py"]
    finally:
        gc.set_threshold(*thresholds)
