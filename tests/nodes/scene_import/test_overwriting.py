"""Commands that make scenes, objects and data sets never replace what they read."""

import hashlib
import re

import pytest

from tests.nodes.scene_import.test_splats import data_set
from tests.support.commands import advnerf
from tests.support.splats import room, write_ply


def content(folder):
    return {
        path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest()
        for path in folder.rglob("*")
        if path.is_file() and path.suffix != ".lock"
    }


@pytest.mark.parametrize(
    "words",
    [
        "from-splat a.ply -o a.ply --metres-per-unit 1",
        "from-splat a.ply -o link.ply --metres-per-unit 1",
        "from-splat a.ply -o set/images/2.png --images set",
        "from-splat a.ply -o set/transforms.json --images set",
        "render s.safetensors set -o views --video s.safetensors",
        "render s.safetensors set -o views --video set/images/0.png",
        "render s.safetensors set -o views --video views/0000_0.png",
        "match-colours s.safetensors set -o set/transforms.json",
        "object build mesh.obj -o mesh.obj --unit m",
        "object build --images set -o set/images/1.png",
        "object show o.png",
        "from-scan set -o set",
        "room target trace.mcap --subject board -o trace.mcap",
    ],
)
def test_an_input_is_never_overwritten(tmp_path, monkeypatch, capsys, words):
    monkeypatch.chdir(tmp_path)
    write_ply(tmp_path / "a.ply", room(100))
    (tmp_path / "link.ply").symlink_to("a.ply")
    data_set(tmp_path / "set", room(100))
    splat = "scene from-splat a.ply -o s.safetensors --metres-per-unit 1"
    assert advnerf(monkeypatch, *splat.split()) == 0
    (tmp_path / "mesh.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\n")
    for name in ("o.png", "trace.mcap"):
        (tmp_path / name).write_bytes(b"anything")
    before = content(tmp_path)
    capsys.readouterr()
    assert advnerf(monkeypatch, "scene", *words.split()) == 2
    error = capsys.readouterr().err
    assert re.search(
        "would be overwritten; choose another|expected an --output that is not the scan itself|expected names for two files",
        error,
    )
    assert error.count("\n") == 1
    assert content(tmp_path) == before
