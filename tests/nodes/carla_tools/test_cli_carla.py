"""The commands `advnerf scene carla ...` as a person types them; behind some, the scripted server stands in for a real one."""

import json
import os
import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hardware.worlds.carla.errors import CarlaMapError, CarlaUnreachable
from nodes.cli import world
from nodes.cli.carla import app
from nodes.lab.worlds import check
from nodes.lab.worlds.geometry import ground_is_flat

ROOT = Path(__file__).parents[3]


def advnerf(*arguments):
    environment = {**os.environ, "OMP_NUM_THREADS": "1", "COLUMNS": "200"}
    command = [sys.executable, "-m", "nodes.cli", "scene", "carla", *map(str, arguments)]
    return subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=ROOT, env=environment)


@pytest.fixture
def check_server(settings):
    """Hold the scripted server against the contract of a world."""
    given = [word for key, value in settings.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    return lambda *options: CliRunner().invoke(world.app, ["check", "carla", *given, *map(str, options)])


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
    done = CliRunner().invoke(world.app, ["check", "carla", "--set", f"server.port={port}"])
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


def test_check_of_a_good_server(as_carla, check_server, tmp_path, monkeypatch):
    monkeypatch.setattr(check, "_CHECKS", (("ground", ground_is_flat),))
    done = check_server("-o", tmp_path / "look")
    assert done.exit_code == 0, done.output
    assert [line.split()[0] for line in done.output.splitlines() if " met " in line][-1] == "ground"
    assert (tmp_path / "look" / "straight_depth.png").is_file()
    assert not as_carla.world.settings.synchronous_mode


def test_junctions_of_a_server(as_carla, port):
    done = CliRunner().invoke(app, ["junctions", "127.0.0.1", "--port", str(port)])
    assert done.exit_code == 0, done.output
    assert done.output.splitlines()[-1].split()[0] == "100"


def test_a_command_that_is_ended_puts_the_world_back(as_carla, check_server):
    driven, tick = as_carla.world, as_carla.world.tick

    def ended(seconds):
        if driven.ticks == 7:
            os.kill(os.getpid(), signal.SIGTERM)
        return tick(seconds)

    driven.tick = ended
    done = check_server()
    assert done.exit_code == 128 + signal.SIGTERM
    assert driven.ticks < 10
    assert not driven.settings.synchronous_mode
    assert not driven.actors


def test_release(as_carla, port):
    as_carla.world.settings.synchronous_mode = True
    as_carla.world.lights_frozen = True
    arguments = ["release", "127.0.0.1", "--port", str(port)]
    assert CliRunner().invoke(app, arguments).output == "the world ticks by itself again\n"
    assert not as_carla.world.settings.synchronous_mode
    assert not as_carla.world.lights_frozen
    assert "nothing to do" in CliRunner().invoke(app, arguments).output
