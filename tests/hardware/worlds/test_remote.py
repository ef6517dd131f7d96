"""A world in another process: it keeps the contract, and every fault of its process ends as a named error, never as a result."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.documents import Document
from hardware.worlds.remote import SERVERS, RemoteServer
from hardware.worlds.remote_errors import (
    RemoteWorldError,
    ServerLost,
    ServerTimeout,
    SimulatorError,
    WrongDepthError,
)
from hardware.worlds.world import NotOpenError, Panel
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.named import read_world
from tests.support.remote.faults import FAULTS, drive, ended, faulty_world, suffer
from tests.support.remote.flat_world import FlatConfig, FlatWorld, plan_fault

WORLD = Path(__file__).parents[2] / "support" / "remote" / "flat_world.py"
pytestmark = pytest.mark.live


def test_a_world_in_another_process_keeps_the_contract() -> None:
    named = read_world(Document({"kind": f"{WORLD}:FlatWorld"}, "test"), Path.cwd())
    assert [f"{each.name}: {each.text}" for each in check_world(named) if not each.met] == []


def test_the_server_imports_nothing_of_ours_and_does_not_see_our_path(tmp_path: Path) -> None:
    simulator = tmp_path / "simulator.py"
    simulator.write_text(
        "import sys\ndef open_simulator(config, cameras):\n    return Told()\nclass Told:\n    def describe(self):\n"
        "        return {'modules': sorted(m for m in sys.modules if m.split('.')[0] in ('hardware', 'nodes', 'advnerf_core'))}, {}\n"
    )
    server = RemoteServer("told", Path(sys.executable), simulator)
    try:
        assert server.call("open", {"config": {}, "cameras": {}}, {}, 10.0).result == {"modules": []}
    finally:
        server.close()


def test_a_simulator_is_opened_with_arrays_where_the_world_sends_some(tmp_path: Path) -> None:
    simulator = tmp_path / "simulator.py"
    simulator.write_text(
        "def open_simulator(config, cameras, **files):\n    return Told(files)\nclass Told:\n    def __init__(self, files):\n"
        "        self.files = files\n    def describe(self):\n        return {'names': sorted(self.files)}, self.files\n"
    )
    server = RemoteServer("told", Path(sys.executable), simulator)
    sent = {"room.xml": np.frombuffer(b"<mujoco/>", np.uint8), "floor.png": np.arange(5, dtype=np.uint8)}
    try:
        answer = server.call("open", {"config": {}, "cameras": {}}, sent, 10.0)
    finally:
        server.close()
    assert answer.result == {"names": sorted(sent)}
    assert all(np.array_equal(answer.arrays[name], data) for name, data in sent.items())


@pytest.fixture(scope="module")
def faulty(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FlatWorld, Path, object]]:
    """A world for one fault after the other, the folder where they are planned, and a drive that had none."""
    folder = tmp_path_factory.mktemp("faulty")
    with faulty_world(folder) as world:
        yield world, folder, drive(world)


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_ends_as_its_named_error_and_the_next_drive_goes_on(
    kind: str, faulty: tuple[FlatWorld, Path, object]
) -> None:
    calls, expected = FAULTS[kind]
    world, folder, whole = faulty
    error, gone = suffer(world, folder, calls[-1], kind, 2)
    assert type(error) is expected
    assert str(error).startswith("world flat: ")
    assert gone
    with pytest.raises(ServerLost, match="call reset first"):
        world.step(0.0, 1.2, 0.1)
    assert drive(world) == whole


@pytest.mark.parametrize("sent", [signal.SIGKILL, signal.SIGTERM])
def test_a_server_that_is_killed_between_calls_is_lost(sent: int) -> None:
    with FlatWorld(FlatConfig()) as world:
        world.reset(6.0, 0.0, 0.0)
        assert world.server is not None
        os.kill(world.server.process.pid, sent)
        with pytest.raises(ServerLost, match=signal.Signals(sent).name):
            world.step(0.0, 1.2, 0.1)


def test_faults_while_opening_leave_no_process(tmp_path: Path) -> None:
    world = faulty_world(tmp_path)
    plan_fault(tmp_path, "open", "raises")
    with pytest.raises(SimulatorError, match="the simulator broke"), world:
        raise AssertionError("it was opened")
    assert world.server is None


def test_what_the_process_wrote_is_told(tmp_path: Path) -> None:
    simulator = tmp_path / "simulator.py"
    simulator.write_text(
        "import sys\nprint('no display of mine', file=sys.stderr)\nsys.stderr.flush()\nimport os\nos._exit(7)\n"
    )
    server = RemoteServer("broken", Path(sys.executable), simulator)
    with pytest.raises(ServerLost, match=r"exit code 7.*no display of mine"):
        server.call("open", {"config": {}, "cameras": {}}, {}, 10.0)
    assert server.process.poll() is not None


def test_an_interpreter_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ServerLost, match="advnerf scene world install gone"):
        RemoteServer("gone", tmp_path / "python", SERVERS / "serve.py")


def test_a_process_that_serves_nothing_is_ended(tmp_path: Path) -> None:
    mute = tmp_path / "mute.py"
    mute.write_text("import time\ntime.sleep(60)\n")
    with pytest.raises(ServerTimeout, match=r"answer to hello within 0\.5 s"):
        RemoteServer("mute", Path(sys.executable), mute, server=mute, starting_s=0.5)


def test_the_server_dies_with_its_client(tmp_path: Path) -> None:
    told = tmp_path / "pid"
    code = (
        "import os, signal, sys\nfrom pathlib import Path\nfrom tests.support.remote.flat_world import FlatConfig, FlatWorld\n"
        "world = FlatWorld(FlatConfig()).__enter__()\n"
        f"Path({str(told)!r}).write_text(str(world.server.process.pid))\nos.kill(os.getpid(), signal.SIGKILL)\n"
    )
    root = Path(__file__).parents[3]
    subprocess.run([sys.executable, "-c", code], cwd=root, env={**os.environ, "PYTHONPATH": str(root)})
    assert ended(int(told.read_text()), orphan=True)


def test_nothing_is_known_before_it_is_open_and_the_map_is_kept_afterwards() -> None:
    world = FlatWorld(FlatConfig())
    for ask in (world.describe, lambda: world.state, lambda: world.reset(0.0, 0.0, 0.0), world.observe):
        with pytest.raises(NotOpenError, match="context manager"):
            ask()
    with world:
        first = world.describe().to_dict()
    assert world.describe().to_dict() == first


def test_a_panel_survives_the_loss_of_the_process(tmp_path: Path) -> None:
    face = np.eye(4)
    face[:3, 3] = 9.0, 0.0, 0.6
    face[:2, :2] = -np.eye(2)
    texture = np.zeros((8, 8, 3), dtype=np.uint8)
    texture[..., 0] = 255
    with faulty_world(tmp_path) as world:
        plain = world.observe_at(6.0, 0.0, 0.0)[0]
        world.add_panel("red", Panel(face, 1.0, 1.0), texture)
        dressed = world.observe_at(6.0, 0.0, 0.0)[0]
        assert np.sum((dressed == (255, 0, 0)).all(axis=-1)) > 100
        suffer(world, tmp_path, "render", "killed", 1)
        assert np.array_equal(world.observe_at(6.0, 0.0, 0.0)[0], dressed)
        world.add_panel("red", Panel(face, 1.0, 1.0), None)
        assert np.array_equal(world.observe_at(6.0, 0.0, 0.0)[0], plain)


def test_depth_is_held_against_the_ground_only_where_the_car_is_free(tmp_path: Path) -> None:
    """A wall right before the camera is no lie of a car that stands against it."""
    with faulty_world(tmp_path) as world:
        world.reset(14.5, 0.0, 0.0)
        assert world.blocked
        plan_fault(tmp_path, "render", "tenths")
        world.observe()
        world.reset(6.0, 0.0, 0.0)
        plan_fault(tmp_path, "render", "tenths")
        with pytest.raises(WrongDepthError, match="lower edge"):
            world.observe()


def test_all_faults_of_remote_worlds_are_world_errors() -> None:
    assert all(issubclass(error, RemoteWorldError) for _, error in FAULTS.values())
