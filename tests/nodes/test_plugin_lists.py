"""What can be named is listed, strangers' too, and what a file's names will execute is said before it is."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

import pytest
from typer.testing import CliRunner

from advnerf_core.attack.methods import METHODS
from advnerf_core.code_files import file_sha256
from hardware.cameras.sources import CAMERAS
from nodes.cli.main import app
from nodes.lab.plugin_tables import TABLES, named_code, rows_of
from nodes.lab.worlds.named import WORLDS
from tests.support.commands import advnerf
from tests.support.strangers import install_method, spiral_code, write_spiral

ROOT = Path(__file__).parents[2]


def command(*arguments: object) -> tuple[int, str]:
    done = CliRunner().invoke(app, [str(each) for each in arguments])
    if isinstance(done.exception, Exception):
        raise done.exception
    return done.exit_code, done.output


@pytest.mark.parametrize(("what", "names"), [("methods", METHODS), ("worlds", WORLDS), ("cameras", CAMERAS)])
def test_everything_that_is_built_in_has_a_line(what: str, names: dict[str, object]) -> None:
    rows = [row for row in rows_of(TABLES[what]) if row.origin == "built in"]
    assert [row.name for row in rows] == list(names)
    assert all(5 < len(row.line) < 120 for row in rows)
    assert len({row.line for row in rows}) == len(rows)


def test_a_package_is_listed_with_its_version_and_title(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    titled = spiral_code().replace("Options=Options)", 'Options=Options, title="along a spiral")')
    install_method(tmp_path, monkeypatch, titled)
    code, printed = command("experiment", "list", "methods")
    assert code == 0
    (line,) = [line for line in printed.splitlines() if line.startswith("spiral")]
    assert line.split() == ["spiral", "stranger-methods", "1.0", "along", "a", "spiral"]


def test_a_package_that_is_broken_is_listed_with_its_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_method(tmp_path, monkeypatch, "import a_package_that_is_not_there\n")
    code, printed = command("experiment", "list", "methods")
    assert code == 0
    assert "cannot be loaded: ModuleNotFoundError: No module named 'a_package_that_is_not_there'" in printed


def test_a_name_that_two_things_have_is_an_error_of_the_list(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    install_method(tmp_path, monkeypatch, spiral_code(), "gradient")
    code, printed = command("experiment", "list", "methods")
    assert code == 1
    assert "expected one thing of the name gradient, got 2 (built in, stranger-methods 1.0)" in printed


def test_named_code_is_found_wherever_it_stands(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = write_spiral(tmp_path)
    (tmp_path / "my_policy.py").write_text("def make(): raise SystemError\n")
    install_method(tmp_path, monkeypatch, "raise SystemError\n", "whirl")
    data = {
        "over": {"method": ["random", "spiral.py:Spiral", "whirl"]},
        "world": {"kind": "missing.py:World"},
        "policy": "my_policy:make",
        "nodes": {"camera": {"module": "nodes.camera"}, "mine": {"module": "my_policy"}},
        "name": "whirl",
    }
    spiral, whirl, policy, node = named_code(data, tmp_path)
    assert spiral == f"{file}:Spiral (sha256 {file_sha256(file)[:12]})"
    assert whirl.startswith("whirl of stranger-methods 1.0 (sha256 ")
    assert policy.startswith("my_policy:make (sha256 ")
    assert node.startswith("my_policy (sha256 ")


def test_a_policy_beside_the_experiment_is_named_with_the_hash_of_its_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    beside, working = tmp_path / "beside", tmp_path / "working"
    for folder in (beside, working):
        folder.mkdir()
    monkeypatch.chdir(working)
    (beside / "policy_beside.py").write_text("raise SystemError\n")
    file = beside / "mine.experiment.yaml"
    file.write_text(
        "name: mine\nworld: {kind: junction}\nvictims: {a: {policy: 'policy_beside:make'}, b: {policy: 'policy_nowhere:make'}}\n"
    )
    assert advnerf(monkeypatch, "experiment", "run", str(file)) == 2  # there are no paths
    printed = capsys.readouterr().err
    content = sha256((beside / "policy_beside.py").read_bytes()).hexdigest()
    expected = sha256(f"\0policy_beside.py\0{content}".encode()).hexdigest()
    assert f"executes policy_beside:make (sha256 {expected[:12]})" in printed
    assert "executes policy_nowhere" not in printed


@pytest.fixture
def trap(tmp_path: Path) -> tuple[Path, Path]:
    """A file with a method that leaves a trace when it is executed, and the trace."""
    file = write_spiral(tmp_path)
    trace = tmp_path / "it_was_executed"
    file.write_text(f"open({str(trace)!r}, 'w').close()\n" + file.read_text())
    return file, trace


@pytest.mark.parametrize("word", ["status", "table", "report"])
def test_reading_commands_execute_no_method(trap: tuple[Path, Path], tmp_path: Path, word: str) -> None:
    file, trace = trap
    methods = f"over.method=[none,'{file}:Spiral']"
    code, printed = command("experiment", word, "junction", "--folder", tmp_path / "run", "--set", methods)
    assert "Spiral" in printed or code == 0
    assert not trace.exists()
