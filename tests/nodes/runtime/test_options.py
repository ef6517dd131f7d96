"""Options: what commands refuse in them."""

from pathlib import Path

import pytest

from nodes.runtime.errors import ConfigError
from nodes.runtime.terminal import listen_address
from tests.support.commands import advnerf

CORNER = Path(__file__).parents[2] / "replay" / "corner.mcap"


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("train", "{folder}", "-o", "{folder}/out", "--box-low", "-inf", "0", "0"), "--box-low"),
        (("train", "{folder}", "-o", "{folder}/out", "--interval-px", "inf"), "--interval-px"),
        (("from-scan", "{folder}", "-o", "{folder}/out", "--length", "a", "b", "inf"), "--length"),
        (("from-scan", "{folder}", "-o", "{folder}/out", "--marker", "inf"), "--marker"),
    ],
)
def test_infinite_numbers_are_refused_with_the_option(tmp_path, monkeypatch, capsys, words, option):
    given = [word.format(folder=tmp_path) for word in words]
    assert advnerf(monkeypatch, "scene", *given) == 2
    assert f"expected finite numbers for {option}, got" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "option"),
    [
        ("bag play {bag} --folder {folder}/run --offset inf", "--offset"),
        ("bag play {bag} --folder {folder}/run --duration inf", "--duration"),
        ("scene room path {bag} -o {folder}/room.yaml --off-track inf", "--off-track"),
        ("scene room fence {bag} -o {folder}/room.yaml --margin inf", "--margin"),
    ],
)
def test_infinite_numbers_about_bags_are_refused_with_the_option(
    tmp_path, monkeypatch, capsys, words, option
):
    """A player ended in a traceback."""
    given = words.format(folder=tmp_path, bag=CORNER).split()
    assert advnerf(monkeypatch, *given) == 2
    assert f"expected finite numbers for {option}, got inf" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    "words",
    [
        "car trial two_hosts --folder {folder}/trial --start nan,0,0",
        "car trial two_hosts --folder {folder}/trial --start 0,0,inf",
        "car trial two_hosts --folder {folder}/trial --start 0,0",
        "scene room target -o {folder}/m.yaml --subject monitor --face-size 0.6x0.3 --centre inf,0,0",
        "scene room target -o {folder}/m.yaml --subject monitor --face-size nan,0.3",
        "scene room target -o {folder}/m.yaml --subject monitor --face-size 0.6",
    ],
)
def test_poses_points_and_sizes_that_are_not_finite_are_refused(tmp_path, monkeypatch, capsys, words):
    given = words.format(folder=tmp_path).split()
    assert advnerf(monkeypatch, *given) == 2
    said = capsys.readouterr().err
    assert f"{given[-2]} {given[-1]}: expected " in said
    assert "finite numbers" in said
    assert not list(tmp_path.iterdir())


def test_a_start_in_degrees_is_refused(tmp_path, monkeypatch, capsys):
    trial = f"car trial two_hosts --folder {tmp_path}/trial --start 0,0,90"
    assert advnerf(monkeypatch, *trial.split()) == 2
    assert "--start 0,0,90: expected radians, at most a turn of 6.2832, got 90" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("listen", ["localhost:99999", "127.0.0.1:65536"])
def test_a_port_that_does_not_exist_is_refused(listen):
    """viser said that it serves there."""
    with pytest.raises(ConfigError, match=rf"to listen on, got {listen}; write a port of at most 65535"):
        listen_address(listen)
    assert listen_address("localhost:65535") == ("localhost", 65535)
