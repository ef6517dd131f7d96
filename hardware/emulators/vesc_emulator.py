"""A VESC on a pseudo terminal that drives the twin's car: the driver opens it like a USB port.

Safety is decided at this end of the wire, so every command is logged with a monotonic stamp, together with the
car's motion at that moment.
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from collections import deque
from pathlib import Path
from typing import TextIO

from advnerf_core.geometry import VehicleState
from hardware.emulators.vesc_firmware import VescEmulatorConfig, VescFirmware, WireEvent
from hardware.errors import HardwareError
from hardware.worlds.lab.vehicle import TwinVehicle

# Below this speed the car counts as standing.
STANDSTILL_MPS = 0.005
LOG_HEADER = "mono_ns,event,value,speed_mps,odometer_m\n"


class VescEmulator:
    """The pty, the firmware behind it, and the car behind that. The physics loop calls `advance`.

    Args:
        vehicle: The car; from now on only this object may move it.
        link: Path for a symbolic link to the terminal, e.g. ``<run_dir>/vesc``; an old link is replaced.
        log: CSV file for the wire log; None keeps it in memory only.

    Attributes:
        firmware: The controller's firmware.
    """

    def __init__(
        self,
        config: VescEmulatorConfig,
        vehicle: TwinVehicle,
        link: Path | None = None,
        log: Path | None = None,
    ) -> None:
        self.vehicle = vehicle
        self.firmware = VescFirmware(config, vehicle, vehicle.params.true_erpm_gain)
        self._lock = threading.RLock()
        self._events: deque[WireEvent] = deque(maxlen=100_000)
        self._moving = False
        self._log: TextIO | None = None
        if log is not None:
            self._log = open(log, "w", buffering=1, encoding="ascii")  # noqa: SIM115 - closed in close()
            self._log.write(LOG_HEADER)
        self._link = link
        self._stop_read, self._stop_write = os.pipe()
        self._open = True
        self._master = self._slave = -1
        self.port = ""
        self.plug_in()

    @property
    def state(self) -> VehicleState:
        """Current state of the car."""
        with self._lock:
            return self.vehicle.state

    def events(self, since_mono_ns: int = 0) -> list[WireEvent]:
        """Events on the wire, oldest first."""
        with self._lock:
            return [event for event in self._events if event.mono_ns >= since_mono_ns]

    def advance(self, dt_s: float, mono_ns: int) -> VehicleState:
        """Move the car by ``dt_s`` up to monotonic time ``mono_ns`` [ns] and run the firmware's watchdog."""
        with self._lock:
            self._note(self.firmware.check_timeout(mono_ns))
            state = self.vehicle.advance(dt_s)
            moving = abs(state.speed_mps) > STANDSTILL_MPS
            if moving != self._moving:
                self._moving = moving
                self._note([WireEvent(mono_ns, "MOVING" if moving else "STANDSTILL")])
            return state

    def place(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Put the car at another pose; refused while it moves or has a motor command."""
        with self._lock:
            speed = self.vehicle.state.speed_mps
            if self.firmware.commanded or abs(speed) > 0.05:
                raise HardwareError(
                    f"expected a car at rest, got {speed:.2f} m/s"
                    f"{' and an active motor command' if self.firmware.commanded else ''}; disarm first"
                )
            self.vehicle.reset(x_m, y_m, yaw_rad)
            self._note([WireEvent(time.monotonic_ns(), "PLACED")])

    def plug_in(self) -> None:
        """Connect the USB plug (again): another terminal, under the same link."""
        if self._master >= 0:
            return
        # The slave end stays open here: without it every client that closes would hang up the master.
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        os.set_blocking(self._master, False)
        self.port = os.ttyname(self._slave)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
            self._link.symlink_to(self.port)
        self._thread = threading.Thread(target=self._serve, name="vesc emulator", daemon=True)
        self._thread.start()

    def hang_up(self) -> None:
        """Pull the USB plug: every open client gets an error."""
        self._stop_thread()
        for descriptor in (self._master, self._slave):
            if descriptor >= 0:
                os.close(descriptor)
        self._master = self._slave = -1

    def close(self) -> None:
        """Disconnect and remove the link."""
        if not self._open:
            return
        self._open = False
        self.hang_up()
        os.close(self._stop_read)
        os.close(self._stop_write)
        if self._link is not None:
            self._link.unlink(missing_ok=True)
        if self._log is not None:
            self._log.close()

    def __enter__(self) -> VescEmulator:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _stop_thread(self) -> None:
        if self._thread.is_alive():
            os.write(self._stop_write, b"x")
            self._thread.join(timeout=2.0)
            os.read(self._stop_read, 1)

    def _serve(self) -> None:
        while True:
            ready = select.select([self._master, self._stop_read], [], [])[0]
            if self._stop_read in ready:
                return
            try:
                data = os.read(self._master, 4096)
            except BlockingIOError:
                continue
            with self._lock:
                replies, events = self.firmware.receive(data, time.monotonic_ns())
                self._note(events)
            self._reply(replies)

    def _reply(self, data: bytes) -> None:
        # Without a reader the bytes are lost, as on a USB endpoint without a host.
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)

    def _note(self, events: list[WireEvent]) -> None:
        self._events.extend(events)
        if self._log is not None and not self._log.closed:
            speed, driven = self.vehicle.state.speed_mps, self.vehicle.odometer_m
            for event in events:
                value = "" if event.value is None else f"{event.value:g}"
                self._log.write(f"{event.mono_ns},{event.name},{value},{speed:.4f},{driven:.4f}\n")
