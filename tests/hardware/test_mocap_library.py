"""The library backend on a small module that plays recorded frames where the library would be, and on the library if it is there."""

import importlib.util
import math
import socket
import sys
import textwrap

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from hardware.errors import DeviceNotFound, HardwareError
from hardware.mocap.library import LibraryConfig, LibraryReceiver

pytestmark = pytest.mark.live

PLAYER = """
import time
from types import SimpleNamespace as Object

FRAMES = []
CONNECTED = []

class _Player:
    def __init__(self):
        self._left = list(FRAMES)
        self.rigidBodies = {}

    def waitForNextFrame(self):
        if not self._left:
            raise RuntimeError("host closed the connection")
        frame = self._left.pop(0)
        self.rigidBodies = {
            name: Object(position=p, rotation=Object(x=q[0], y=q[1], z=q[2], w=q[3])) for name, (p, q) in frame.items()
        }

def connect(system, settings):
    CONNECTED.append((system, dict(settings)))
    return _Player()
"""
UP = (0.0, 0.0, 0.0, 1.0)
CONFIG = LibraryConfig("optitrack", "10.0.0.7", ("car", "board"), latency_s=0.01, frozen_frames=3)


@pytest.fixture
def player(tmp_path, monkeypatch):
    (tmp_path / "motioncapture.py").write_text(textwrap.dedent(PLAYER))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.delitem(sys.modules, "motioncapture", raising=False)
    import motioncapture

    yield motioncapture
    sys.modules.pop("motioncapture", None)


def everything(receiver):
    poses = []

    def read_on():
        while True:
            poses.extend(receiver.read(0.2))

    with pytest.raises(HardwareError, match="host closed the connection"):
        read_on()
    return poses


def test_poses_in_metres_with_their_rotation(player):
    q = Rotation.from_euler("xyz", [0.1, -0.2, 0.9]).as_quat()
    player.FRAMES += [{"car": ((1.0, 2.0, 0.1), tuple(q)), "stranger": ((1.0, 1.0, 1.0), UP)}]
    with LibraryReceiver(CONFIG) as receiver:
        (pose,) = everything(receiver)
    assert player.CONNECTED == [("optitrack", {"hostname": "10.0.0.7"})]
    assert pose.name == "car"
    np.testing.assert_allclose(
        pose.T_world_from_subject[:3, :3], Rotation.from_quat(q).as_matrix(), atol=1e-12
    )
    np.testing.assert_allclose(pose.T_world_from_subject[:3, 3], [1.0, 2.0, 0.1])


def test_every_form_of_lost(player):
    good, same = {"car": ((1.0, 2.0, 0.1), UP)}, {"car": ((3.0, 2.0, 0.1), UP)}
    player.FRAMES += [
        good,
        {},
        {"car": ((0.0, 0.0, 0.0), UP)},
        {"car": ((math.nan, 1.0, 1.0), UP)},
        *[same] * 6,
    ]
    player.FRAMES += [{"car": ((3.1, 2.0, 0.1), (0.0, 0.0, 0.0, 0.0))}]
    with LibraryReceiver(CONFIG) as receiver:
        poses = everything(receiver)
        counts = receiver.counts
    assert [p.T_world_from_subject[0, 3] for p in poses] == [1.0, 3.0, 3.0, 3.0]
    assert counts.lost["car"] == 2 + 3
    assert counts.datagrams == 11


def test_without_the_library(monkeypatch):
    monkeypatch.setitem(sys.modules, "motioncapture", None)
    with pytest.raises(DeviceNotFound, match=r"pip install 'advnerf\[mocap\]'"):
        LibraryReceiver(CONFIG)


def test_a_host_that_is_not_there_is_one_error_and_no_endless_wait(player):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        with pytest.raises(DeviceNotFound, match="is it running"):
            LibraryReceiver(LibraryConfig("qualisys", "127.0.0.1", ("car",)))


def test_unknown_system():
    with pytest.raises(ValueError, match="expected a motion capture system of vicon"):
        LibraryConfig("kinect", "localhost", ("car",))


@pytest.mark.skipif(importlib.util.find_spec("motioncapture") is None, reason="optional library")
def test_the_real_library_sees_nobody_in_its_empty_room():
    with LibraryReceiver(LibraryConfig("mock", "localhost", ("car",))) as receiver:
        assert receiver.read(0.2) == []
        assert receiver.counts.datagrams > 0
