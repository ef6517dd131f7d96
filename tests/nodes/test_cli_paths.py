"""A wrong path is named before anything heavy is imported."""

import subprocess
import sys
from pathlib import Path
from typing import Annotated, get_args, get_origin, get_type_hints

import pytest

from nodes.cli.main import app

# What a command writes, or makes if it is not there, or looks up itself among other places.
WRITTEN = {
    "output", "out", "folder", "run_dir", "run_folder", "golden", "json_file", "plot", "video", "onnx", "pt2", "pictures", "python",
    "factory", "mount", "to", "source",
}  # fmt: skip
HEAVY = ("torch", "scipy", "numba", "pycolmap", "mujoco")


def commands(group, name=""):
    for command in group.registered_commands:
        yield f"{name} {command.name or command.callback.__name__}".strip(), command.callback
    for inner in group.registered_groups:
        yield from commands(inner.typer_instance, f"{name} {inner.name or ''}".strip())


def parts(annotation):
    yield annotation
    for part in get_args(annotation):
        yield from parts(part)


def test_every_path_that_a_command_reads_is_checked_as_it_is_parsed():
    loose, read = [], 0
    for name, callback in commands(app):
        for parameter, annotation in get_type_hints(callback, include_extras=True).items():
            if get_origin(annotation) is not Annotated or Path not in parts(annotation):
                continue
            info = annotation.__metadata__[0]
            read += bool(info.exists or info.parser)
            if not (info.exists or info.parser or parameter in WRITTEN):
                loose.append(f"{name}: {parameter}")
    assert loose == []
    assert read > 40


@pytest.mark.parametrize(
    "arguments",
    [
        ("scene", "train", "nope", "-o", "out"),
        ("scene", "view", "nope"),
        ("scene", "from-images", "nope", "-o", "out"),
        ("scene", "object", "build", "nope.glb"),
        ("scene", "object", "show", "nope"),
        ("attack", "show", "nope"),
        ("policy", "train", "nope", "-o", "out"),
        ("policy", "log", "info", "nope,images=left"),
        ("policy", "check", "nope.onnx"),
        ("policy", "eval", "nope:factory", "nope"),
        ("audit", "mine.onnx", "--world", "lab", "--limit", "nope"),
        ("audit", "mine.onnx", "--world", "lab", "--budget", "nope"),
        ("audit", "mine.onnx", "--world", "lab", "--object", "nope"),
    ],
    ids=" ".join,
)
def test_a_wrong_path_or_value_costs_no_heavy_import(tmp_path, arguments):
    program = (
        "import sys\nfrom nodes.cli import main\n"
        f"sys.argv = ['advnerf', *{arguments!r}]\n"
        "try:\n    main.main()\nexcept SystemExit as ended:\n    print('code', ended.code)\n"
        f"print('heavy', [name for name in {HEAVY!r} if name in sys.modules])"
    )
    ran = subprocess.run(
        [sys.executable, "-c", program],
        capture_output=True,
        text=True,
        cwd=tmp_path,
        timeout=600,
        env={"PYTHONPATH": str(Path(__file__).parents[2]), "PATH": "/usr/bin:/bin", "HOME": str(tmp_path)},
    )
    assert ran.stdout.split() == ["code", "64" if arguments[0] == "audit" else "2", "heavy", "[]"], ran.stderr
    assert "nope" in ran.stderr
    assert not (tmp_path / "out").exists()
