"""The command line as a whole: few entries in titled panels, help for everything, one name for one thing, one look of errors."""

from __future__ import annotations

import inspect
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
import typer

from nodes.cli import endings, program
from nodes.cli.main import PANELS, app
from tests.support.commands import advnerf

ROOT = Path(__file__).parents[2]
# The same thing has the same name everywhere: the folder of a run, and what a command writes.
FOLDER_OPTIONS = {"--folder", "--output"}
GONE = {"--run-dir", "--run-folder", "--out", "--in", "--from", "--to"}


def commands(group: Any = None, name: str = "") -> Any:
    """Every command that is no group, with its full name."""
    group = group or typer.main.get_command(app)
    for word, command in group.commands.items():
        if hasattr(command, "commands"):
            yield from commands(command, f"{name}{word} ")
        else:
            yield f"{name}{word}", command


def test_the_first_help_is_short_and_in_five_titled_panels(capsys: pytest.CaptureFixture[str]) -> None:
    entries = [name for names in PANELS.values() for name in names]
    assert sorted(typer.main.get_command(app).commands) == sorted(entries)  # type: ignore[attr-defined]
    assert (len(entries) <= 13, len(PANELS)) == (True, 5)
    with pytest.raises(SystemExit, match="0"):
        app(["--help"], prog_name="advnerf")
    shown = capsys.readouterr().out
    assert [shown.index(f"─ {title} ─") for title in PANELS] == sorted(
        shown.index(f"─ {title} ─") for title in PANELS
    )
    assert re.search(r"disarm +Stop the car", shown)


def test_every_command_and_every_parameter_has_help() -> None:
    found = list(commands())
    assert len(found) > 80
    assert [name for name, command in found if not command.help] == []
    parameters = [(name, each) for name, command in found for each in command.params]
    assert [f"{name} {each.name}" for name, each in parameters if not (each.help or "").strip()] == []


def test_units_are_shown_in_the_help(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rich takes ``[m]`` for markup, and leaves it out without a word."""
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 400)
    checked = 0
    for name, command in commands():
        brackets = [
            found
            for each in (command, *command.params)
            for found in re.findall(r"\[[a-zA-Z][^\]]*\]", each.help or "")
        ]
        if not brackets:
            continue
        with pytest.raises(SystemExit, match="0"):
            app([*name.split(), "--help"], prog_name="advnerf")
        shown = capsys.readouterr().out
        assert {each: shown.count(each) for each in brackets} == {
            each: brackets.count(each) for each in brackets
        }, name
        assert "\\[" not in shown
        checked += len(brackets)
    assert checked > 20


def test_options_for_folders_have_two_names_and_one_name_means_one_thing() -> None:
    meanings: dict[str, set[str]] = {}
    folders = set()
    for _, command in commands():
        for option in command.params:
            if option.param_type_name != "option":
                continue
            meanings.setdefault(option.opts[0], set()).add(str(option.help))
            if re.match(r"(New |Run |Key )?folder\b", option.help or "", re.IGNORECASE):
                folders.add(option.opts[0])
    assert folders == FOLDER_OPTIONS
    assert GONE.isdisjoint(meanings)
    assert len(meanings["--device"]) == 1
    assert all(text.startswith("Host of the launch file") for text in meanings["--host"])
    assert all("to this width and height" in text for text in meanings["--size"])


def test_a_name_stands_for_one_command_except_the_stop() -> None:
    callbacks: dict[Any, list[str]] = {}
    for name, command in commands():
        callbacks.setdefault(inspect.unwrap(command.callback), []).append(name)
    assert [names for names in callbacks.values() if len(names) > 1] == [["disarm", "car disarm"]]


@pytest.mark.parametrize("words", [["disarm"], ["car", "disarm"]])
def test_either_stop_goes_the_short_way(monkeypatch: pytest.MonkeyPatch, words: list[str]) -> None:
    given = []
    monkeypatch.setattr(program, "_disarm", lambda options: given.append(options) or 0)
    monkeypatch.setattr(program, "promise_first_word", lambda: None)
    monkeypatch.setattr(sys, "argv", ["advnerf", *words, "--reason", "look out"])
    with pytest.raises(SystemExit, match="0"):
        program.main()
    assert given == [["--reason", "look out"]]


def test_a_stop_with_a_wrong_option_says_that_nothing_is_confirmed() -> None:
    ended = run("disarm", "--run-dir", "x")
    assert (ended.returncode, ended.stdout) == (2, "")
    assert ended.stderr.startswith("error: NOT CONFIRMED: unrecognized arguments: --run-dir x; expected ")


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (("bag", "play"), 2, r"error: missing argument 'BAG'; see .* bag play --help"),
        (("bag", "play", ".", "--rate", "-1"), 2, r"error: invalid value for '--rate': .*; see .* --help"),
        (
            ("scene", "train", ".", "-o", "x", "--box-low", "3,3,3", "--box-high", "4,4,4"),
            2,
            r"error: invalid value for '--box-low': expected a valid number, got '3,3,3'; separate its 3 values by spaces; see .* --help",
        ),
        (
            ("scene", "train", ".", "-o", "x", "--box-low", "3,3,3"),
            2,
            r"error: option '--box-low' requires 3 arguments, separated by spaces(; see .* --help)?",
        ),
        (
            ("scene", "from-scan", ".", "-o", "x", "--length", "A", "B", "3m"),
            2,
            r"error: invalid value for '--length': expected a valid number, got '3m'; separate its 3 values by spaces; see .* --help",
        ),
        (
            ("scene", "train", ".", "-o", "x", "--every", "x"),
            2,
            r"error: invalid value for '--every': expected a valid integer, got 'x'; see .* --help",
        ),
        (
            ("scene", "train", ".", "-o", "x", "--every", "1"),
            2,
            r"error: invalid value for '--every': expected a value greater than or equal to 2, got '1'; see .* --help",
        ),
        (("car", "fly"), 2, r"error: no such command 'fly'; see .* car --help"),
        (("audit", "a:b", "--no-such-option"), 64, r"error: no such option: --no-such-option; see .* --help"),
    ],
)
def test_a_wrong_command_line_is_one_line_as_every_other_error(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], words: Any, code: int, text: str
) -> None:
    assert advnerf(monkeypatch, *words) == code
    errors = capsys.readouterr().err
    assert re.fullmatch(text, errors.strip(), re.IGNORECASE), errors


@pytest.mark.parametrize("words", ["view", "eval {} x", "render {} x -o x", "match-colours {} x"])
@pytest.mark.parametrize(
    ("made", "advice"),
    [
        ("learned/scene.safetensors", "give {folder}/learned/scene.safetensors"),
        ("transforms.json", "it holds images, so run: advnerf scene train {folder} -o {folder}/learned"),
        (
            "poses_bounds.npy",
            "it is of the format LLFF, so run: advnerf scene from-scan {folder} -o NEW_FOLDER",
        ),
        ("a.txt", "give a scene.safetensors, which 'advnerf scene train' and 'from-splat' write"),
    ],
)
def test_a_folder_for_a_scene_file_is_told_what_makes_one(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
    words: str,
    made: str,
    advice: str,
) -> None:
    file = tmp_path / made
    file.parent.mkdir(exist_ok=True)
    file.touch()
    monkeypatch.chdir(tmp_path)
    Path("x").touch()
    command = words.format(tmp_path) if "{}" in words else f"{words} {tmp_path}"
    assert advnerf(monkeypatch, "scene", *command.split()) == 2
    error = " ".join(capsys.readouterr().err.split())
    assert (
        f"expected a scene file, got the folder {tmp_path}; {advice.format(folder=tmp_path)}; see " in error
    )


def test_a_shell_completes_groups_and_commands() -> None:
    for typed, expected in (("advnerf car cal", "calibrate"), ("advnerf car calibrate veh", "vehicle")):
        environment = {"_ADVNERF_COMPLETE": "complete_bash"}
        words = {"COMP_WORDS": typed, "COMP_CWORD": str(len(typed.split()) - 1)}
        code = "import sys; sys.argv = ['advnerf']; from nodes.cli.program import main; main()"
        ended = subprocess.run(
            [sys.executable, "-c", code],
            env={**os.environ, **environment, **words},
            capture_output=True,
            text=True,
            timeout=600,
        )
        assert ended.stdout.split() == [expected], ended.stderr


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_command_that_was_stopped_names_the_one_that_continues(tmp_path: Path, number: int) -> None:
    code = (
        "import os, signal, sys, time; from nodes.cli import main\n"
        # Where the tests run in the background of a shell, SIGINT is ignored by what they start.
        "signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "for each in (signal.SIGHUP, signal.SIGQUIT): signal.signal(each, signal.SIG_DFL)\n"
        f"def stopped(**_):\n    os.kill(os.getpid(), {int(number)})\n    time.sleep(60)\n"
        "main.app = stopped; sys.argv = ['advnerf', 'scene', 'train', 'my pictures', '-o', 'out']; main.main()"
    )
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=600)
    assert ended.returncode == 128 + number
    line = "error: stopped; the same command continues: advnerf scene train 'my pictures' -o out\n"
    assert ended.stderr == line


def test_commands_that_continue_are_there() -> None:
    there = {tuple(name.split()) for name, _ in commands()}
    assert there.issuperset(endings._RESUMABLE)
    assert not endings.is_resumable(["launch", "room"])
    assert endings.is_resumable(["--debug", "experiment", "run", "room"])


def run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "nodes.cli", *words]
    return subprocess.run(command, capture_output=True, text=True, timeout=600)
