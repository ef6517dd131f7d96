"""The commands `advnerf scene carla ...` as a person types them; behind some, the scripted server stands in for a real one."""

import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from hardware.worlds.carla.errors import CarlaMapError, CarlaUnreachable
from nodes.cli.carla import app
from nodes.lab.worlds import check
from nodes.lab.worlds.geometry import ground_is_flat
from nodes.runtime.errors import ConfigError

ROOT = Path(__file__).parents[3]


def advnerf(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    command = [sys.executable, "-m", "nodes.cli", "scene", "carla", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=ROOT, env=environment)


@pytest.fixture
def file(settings, tmp_path):
    path = tmp_path / "carla.yaml"
    path.write_text(yaml.safe_dump(settings))
    return path


def nobodys_port():
    with socket.create_server(("127.0.0.1", 0)) as free:
        return free.getsockname()[1]


def test_an_error_is_one_line(carla):
    port = nobodys_port()
    done = advnerf("release", "127.0.0.1", "--port", port)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: expected a CARLA server at 127.0.0.1:{port}")
    assert len(done.stderr.splitlines()) == 1


def test_check_without_a_server(carla):
    port = nobodys_port()
    done = CliRunner().invoke(app, ["check", "127.0.0.1", "--port", str(port)])
    assert isinstance(done.exception, CarlaUnreachable)
    assert f"expected a CARLA server at 127.0.0.1:{port}" in str(done.exception)


def test_junctions_of_a_file(carla, TJunction, tmp_path):
    good, bad = tmp_path / "t.xodr", tmp_path / "bad.xodr"
    good.write_text(TJunction(x_m=12.0).text())
    bad.write_text("<OpenDRIVE/>")
    done = CliRunner().invoke(app, ["junctions", "--opendrive", str(good)])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1].split() == ["100", "12.0", "4.1", "3", "1"]
    for wrong in (bad, tmp_path):
        done = CliRunner().invoke(app, ["junctions", "--opendrive", str(wrong)])
        assert isinstance(done.exception, CarlaMapError)
        assert str(done.exception).startswith("expected an OpenDRIVE map")


def test_a_misspelt_key_is_told_with_its_line(tmp_path):
    path = tmp_path / "carla.yaml"
    path.write_text("server:\n  hostt: there\n")
    done = CliRunner().invoke(app, ["check", "--config", str(path)])
    assert isinstance(done.exception, ConfigError)
    assert f"{path}:2: unknown key server.hostt" in str(done.exception)


def test_check_of_a_good_server(as_carla, file, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "_CHECKS", (("ground", ground_is_flat),))
    done = CliRunner().invoke(app, ["check", "--config", str(file), "-o", str(tmp_path / "look")])
    assert done.exit_code == 0, done.output
    assert [line.split()[0] for line in done.output.splitlines() if " met " in line][-1] == "ground"
    assert (tmp_path / "look" / "straight_depth.png").is_file()
    assert not as_carla.world.settings.synchronous_mode


def test_junctions_of_a_server(as_carla, port):
    done = CliRunner().invoke(app, ["junctions", "127.0.0.1", "--port", str(port)])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1].split()[0] == "100"


def test_a_command_that_is_ended_puts_the_world_back(as_carla, file):
    world, tick = as_carla.world, as_carla.world.tick

    def ended(seconds):
        if world.ticks == 7:
            os.kill(os.getpid(), signal.SIGTERM)
        return tick(seconds)

    world.tick = ended
    done = CliRunner().invoke(app, ["check", "--config", str(file)])
    assert done.exit_code == 128 + signal.SIGTERM
    assert world.ticks < 10
    assert not world.settings.synchronous_mode
    assert not world.actors


def test_release(as_carla, port):
    as_carla.world.settings.synchronous_mode = True
    as_carla.world.lights_frozen = True
    arguments = ["release", "127.0.0.1", "--port", str(port)]
    assert CliRunner().invoke(app, arguments).output == "the world ticks by itself again\n"
    assert not as_carla.world.settings.synchronous_mode
    assert not as_carla.world.lights_frozen
    assert "nothing to do" in CliRunner().invoke(app, arguments).output
