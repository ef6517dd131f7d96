import hashlib
import os
import subprocess
import sys
from contextlib import closing

import numpy as np
import pytest

from hardware.emulators.monitor_port import MonitorPort
from hardware.errors import DeviceBusy, DeviceNotFound, LinkLost
from hardware.screen.display import PygameDisplay, TwinDisplay
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

SIZE_M = (0.5977, 0.3362)


@pytest.fixture
def offscreen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "offscreen")


def noise(width, height, seed=0):
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


@pytest.mark.own_process
@pytest.mark.filterwarnings("default::DeprecationWarning")
def test_a_real_sdl_window_holds_exactly_the_pixels_that_were_shown(offscreen):
    display = PygameDisplay(0, (1920, 1080))
    try:
        picture = noise(1920, 1080)
        assert display.show(picture) > 0.0
        np.testing.assert_array_equal(display.read_back(), picture)
        display.show(picture[::-1])
        np.testing.assert_array_equal(display.read_back(), picture[::-1])
        with pytest.raises(ValueError, match=r"\[1080, 1920, 3\]"):
            display.show(picture[:-1])
        display._pygame.event.post(display._pygame.event.Event(display._pygame.QUIT))
        with pytest.raises(LinkLost, match="was closed at the monitor"):
            display.keep_alive()
    finally:
        display.close()


@pytest.mark.own_process
def test_a_screen_that_does_not_exist_is_named(offscreen):
    with pytest.raises(DeviceNotFound, match="index 3, found 0: "):
        PygameDisplay(3)


def test_a_driver_that_gives_another_size_is_refused():
    # SDL's dummy driver with FULLSCREEN or a too large desktop does this; the check must hold whatever the reason.
    script = (
        "import pygame; real = pygame.display.set_mode\n"
        "pygame.display.set_mode = lambda size, *a, **k: real((1024, 768), *a, **k)\n"
        "from hardware.screen.display import PygameDisplay; PygameDisplay(0, (1920, 1080))"
    )
    environment = {**os.environ, "SDL_VIDEODRIVER": "offscreen"}
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=600
    )
    assert "HardwareError: expected a window of 1920 x 1080 px, got (1024, 768)" in done.stderr


def test_the_twins_monitor_says_its_size_and_shows_what_it_is_sent(tmp_path):
    with closing(MonitorPort(tmp_path / "monitor", SIZE_M, (64, 36))) as port:
        display = TwinDisplay(tmp_path / "monitor")
        assert display.edid.size_mm == (598.0, 336.0)
        assert display.size_px == (64, 36)
        assert port.take() == (False, None)
        picture = noise(64, 36)
        display.show(picture)
        is_new, shown = port.take()
        assert is_new
        np.testing.assert_array_equal(shown, picture)
        np.testing.assert_array_equal(display.read_back(), picture)
        assert port.take() == (False, None)
        display.keep_alive()
        display.close()
        assert changed(port) == (True, None)  # idle again: a dead monitor node shows no attack


def changed(port):
    return wait_for(lambda: (taken := port.take())[0] and taken, "the screen to change")


def test_a_second_source_is_refused_and_a_lost_twin_noticed(tmp_path, monkeypatch):
    monkeypatch.setattr("hardware.screen.display._TIMEOUT_S", 1.0)
    port = MonitorPort(tmp_path / "monitor", SIZE_M, (64, 36))
    display = TwinDisplay(tmp_path / "monitor")
    with pytest.raises(DeviceBusy, match="is used by another program"):
        TwinDisplay(tmp_path / "monitor")
    with pytest.raises(DeviceBusy, match="stop the other twin"):
        MonitorPort(tmp_path / "monitor", SIZE_M)
    port.close()
    with pytest.raises(LinkLost):
        display.keep_alive()
    with pytest.raises(LinkLost):
        display.show(noise(64, 36))
    display.close()
    with pytest.raises(DeviceNotFound, match="is the twin running"):
        TwinDisplay(tmp_path / "monitor")


def test_a_picture_cut_off_in_the_middle_is_not_shown(tmp_path):
    with closing(MonitorPort(tmp_path / "monitor", SIZE_M, (64, 36))) as port:
        display = TwinDisplay(tmp_path / "monitor")
        display._socket.sendall(b"S" + bytes(1000))
        display.close()
        assert changed(port) == (True, None)
        again = TwinDisplay(tmp_path / "monitor")  # and the port goes on
        again.show(noise(64, 36, 1))
        assert (
            hashlib.sha256(changed(port)[1].tobytes()).digest()
            == hashlib.sha256(noise(64, 36, 1).tobytes()).digest()
        )
        again.close()
