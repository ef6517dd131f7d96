"""What the documentation names is there: files, benchmarks, commands and their options."""

import json
import re
import shlex
from pathlib import Path

import pytest
import typer

from benchmarks.results import MACHINE_PATH, record_row
from nodes.cli.main import app

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
_FILE = re.compile(
    r"`((?:nodes|advnerf_core|hardware|calibration|launch|benchmarks|tests|docs|examples)/[\w/.\-]+?\.(?:py|yaml|md|json|sh))`"
)
_NOT_OURS = ("my_", "ours")


@pytest.fixture(scope="module")
def command():
    return typer.main.get_command(app)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_links_and_files_of_a_page_are_there(page):
    text = page.read_text()
    links = [target for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text) if "://" not in target]
    missing = [target for target in links if not (page.parent / target).exists()]
    named = [
        name
        for name in _FILE.findall(text)
        if not any(part.startswith(_NOT_OURS) for part in Path(name).parts)
    ]
    missing += [name for name in named if not (ROOT / name).exists()]
    missing += [
        name
        for name in re.findall(r"python -m (benchmarks\.\w+)", text)
        if not (ROOT / f"{name.replace('.', '/')}.py").exists()
    ]
    assert missing == []


def test_rows_name_benchmarks_and_campaigns_that_are_there():
    rows = json.loads((ROOT / "docs" / "results.json").read_text())
    names = {name for row in rows for name in re.findall(r"(?:benchmarks\.|ONLY=)(\w+)", row["command"])}
    # Rows of before the campaigns became tests name them as benchmarks.
    there = {file.stem for file in (ROOT / "benchmarks").glob("*.py")}
    there |= {file.stem.removeprefix("test_") for file in (ROOT / "tests" / "campaigns").glob("test_*.py")}
    assert names
    assert names - there == set()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_commands_of_a_page_and_their_options_exist(page, command):
    wrong = [line for line in commands_of(page.read_text()) if not is_a_command(command, line)]
    assert wrong == []


def commands_of(text):
    """Lines of code blocks that call the command, continuation lines joined, comments cut off."""
    joined = text.replace("\\\n", " ")
    return [match.strip() for match in re.findall(r"^    (advnerf [^#\n|]*)", joined, flags=re.MULTILINE)]


def is_a_command(command, line):
    words = [word for word in shlex.split(line)[1:] if word not in ("...", "&")]
    here = command
    for word in words:
        if not hasattr(here, "commands"):
            break
        if word not in here.commands:
            return word.startswith("-") or "|" in word  # an option of the group, or alternatives such as a|b
        here = here.commands[word]
    known = {name for parameter in here.params for name in (*parameter.opts, *parameter.secondary_opts)} | {
        "--help"
    }
    asked = {word.partition("=")[0] for word in words if word.startswith("--")}
    return asked <= known


def test_what_is_no_command_is_noticed(command):
    assert is_a_command(command, "advnerf experiment run FILE --jobs 2")
    assert not is_a_command(command, "advnerf car keys ran FILE")
    assert not is_a_command(command, "advnerf experiment run FILE --jobbs 2")
    assert commands_of("text\n\n    advnerf car arm   # drives\n") == ["advnerf car arm"]


def test_results_hold_no_path_of_the_machine_they_were_made_on():
    files = [ROOT / "docs" / "results.json", *sorted((ROOT / "docs" / "results").rglob("*.json"))]
    assert len(files) > 100
    assert [str(file) for file in files if re.search(r'"/\w+/', file.read_text())] == []
    texts = (ROOT / "docs" / "results.json").read_text(), (ROOT / "docs" / "results.md").read_text()
    assert [found for text in texts if (found := MACHINE_PATH.search(text))] == []


@pytest.mark.parametrize(
    ("text", "path"),
    [
        ("31 minutes, samples in /tmp/advnerf-v1gdx9lg; worst: recorder", "/tmp/advnerf-v1gdx9lg;"),
        ("git clone . /tmp/clone", "/tmp/clone"),
        ("kept in (/home/ada/runs)", "/home/ada/runs)"),
        ("python -m benchmarks.objects runs/full", None),
        ("drives/home and 3/4 of ../tmp/x, ~/work/x", None),
    ],
)
def test_paths_of_a_machine_are_noticed_anywhere_in_a_row(tmp_path, text, path):
    found = MACHINE_PATH.search(text)
    assert (found and found[0]) == path
    ledger = {"ledger": tmp_path / "r.json", "page": tmp_path / "r.md"}
    if path is None:
        record_row("a", 1, "m", "", None, text, **ledger)
        return
    with pytest.raises(ValueError, match="without paths of this machine"):
        record_row("a", 1, "m", "", None, "command", text, **ledger)
    assert not ledger["ledger"].exists()
