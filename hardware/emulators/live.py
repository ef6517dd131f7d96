"""The simulated lab in real time, behind the real protocols: a VESC on a pty, VICON packets, stamped frames on a socket.

Four threads share one car: the VESC's (bytes in, bytes out), physics (200 Hz, absolute schedule; it catches up after a delay,
as in real time), VICON (100 Hz), and the camera, which owns the OpenGL context and draws the world at the time of the stamp.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from contextlib import ExitStack
from pathlib import Path

import numpy as np
from pydantic import Field, model_validator

from advnerf_core.geometry import Array, VehicleState
from advnerf_core.strict import StrictModel
from hardware.cameras.effects import PRESETS, Effects, ImperfectCamera, Rgb
from hardware.cameras.interface import Frame
from hardware.emulators.frame_server import FrameServer
from hardware.emulators.monitor_port import MonitorPort
from hardware.emulators.pacing import NS_PER_S, Pacer
from hardware.emulators.vesc_emulator import VescEmulator
from hardware.emulators.vesc_firmware import VescEmulatorConfig
from hardware.emulators.vicon_emulator import ViconEmulator, ViconEmulatorConfig
from hardware.errors import HardwareError
from hardware.worlds.lab.config import LabConfig
from hardware.worlds.lab.furniture import vehicle_in_room
from hardware.worlds.lab.lab import Lab

# A stall longer than this (a suspended laptop) is not driven through blindly.
_LONGEST_STEP_S = 0.5
_HISTORY_S = 2.0
_HELD_UP_S = 0.2
_BUILDING_S = 60.0


class LiveLabConfig(StrictModel):
    """The live twin.

    Attributes:
        lab: The world.
        vesc: The motor controller.
        vicon: The motion capture system.
        physics_rate_hz: Steps of the car per second.
        start_pose: Initial pose of the car: x [m], y [m], yaw [rad].
        camera_effects: Imperfections of the camera: ``ideal``, ``webcam``, ``zed``, or the effects themselves.
        camera_latency_s: Time from the end of an exposure to the picture's arrival [s], as of a camera's readout and USB; less than the
            camera's period. A picture that takes longer to draw arrives later. Without it a standing car's pictures, which are drawn once,
            arrive sooner than a moving one's with exposure, and the first of those comes after a gap.
    """

    lab: LabConfig = LabConfig()
    vesc: VescEmulatorConfig = VescEmulatorConfig()
    vicon: ViconEmulatorConfig = ViconEmulatorConfig()
    physics_rate_hz: float = Field(default=200.0, ge=100.0, le=1000.0)
    start_pose: tuple[float, float, float] = (-1.1, -2.0, 0.0)
    camera_effects: Effects = PRESETS["ideal"]
    camera_latency_s: float = Field(default=0.0, ge=0.0)

    @model_validator(mode="after")
    def _pictures_do_not_overtake(self) -> LiveLabConfig:
        period_s = 1.0 / self.lab.camera.rate_hz
        if self.camera_latency_s >= period_s:
            raise ValueError(
                f"expected camera_latency_s below {period_s:g} s, the period of lab.camera, got {self.camera_latency_s:g} s"
            )
        return self


class PoseHistory:
    """Pose of the car by monotonic time; VICON and camera query it for the time of their measurement."""

    def __init__(self, rate_hz: float) -> None:
        self._states: deque[tuple[int, VehicleState]] = deque(maxlen=math.ceil(_HISTORY_S * rate_hz))
        self._changed = threading.Condition()

    def add(self, mono_ns: int, state: VehicleState) -> None:
        """Note the state at an instant."""
        with self._changed:
            self._states.append((mono_ns, state))
            self._changed.notify_all()

    def clear(self) -> None:
        """Discard all states: the car was lifted, and the displacement is no motion."""
        with self._changed:
            self._states.clear()

    def at(self, mono_ns: int, wait_s: float = 0.0) -> VehicleState | None:
        """State at an instant, interpolated; after waiting up to ``wait_s`` for it, the newest one."""
        with self._changed:
            self._changed.wait_for(lambda: bool(self._states) and self._states[-1][0] >= mono_ns, wait_s)
            if not self._states:
                return None
            later = self._states[-1]
            for earlier in reversed(self._states):
                if earlier[0] <= mono_ns:
                    return _between(earlier, later, mono_ns)
                later = earlier
            return later[1]


def _between(a: tuple[int, VehicleState], b: tuple[int, VehicleState], mono_ns: int) -> VehicleState:
    if b[0] <= a[0] or mono_ns >= b[0]:
        return b[1] if mono_ns >= b[0] else a[1]
    w, p, q = (mono_ns - a[0]) / (b[0] - a[0]), a[1], b[1]
    turn = math.remainder(q.yaw_rad - p.yaw_rad, 2.0 * math.pi)
    return VehicleState(
        p.x_m + w * (q.x_m - p.x_m),
        p.y_m + w * (q.y_m - p.y_m),
        p.yaw_rad + w * turn,
        p.speed_mps + w * (q.speed_mps - p.speed_mps),
        p.steering_rad + w * (q.steering_rad - p.steering_rad),
    )


class LiveLab:
    """The whole lab; it lives from construction to `close`.

    In the run folder: ``vesc`` (link to the pty), ``vesc_wire.csv`` (bytes that the controller read); in the socket folder: ``frames``, and ``monitor``, the plug of the monitor.

    Args:
        run_dir: Folder for the link and the log.
        socket_dir: Folder for the socket, whose path may have at most 107 characters; None uses the run folder.

    Attributes:
        vesc: The motor controller, with its wire log.
        vicon: The motion capture system.
    """

    def __init__(
        self,
        config: LiveLabConfig,
        run_dir: Path,
        socket_dir: Path | None = None,
    ) -> None:
        self.config = config
        self.vesc_port = run_dir / "vesc"
        self.frames_path = (socket_dir or run_dir) / "frames"
        self.monitor_path = (socket_dir or run_dir) / "monitor"
        self._stop = threading.Event()
        self._ready = threading.Event()
        self._failure: BaseException | None = None
        self._history = PoseHistory(config.physics_rate_hz)
        self._physics_pacer = Pacer(config.physics_rate_hz)
        self._camera_pacer = Pacer(config.lab.camera.rate_hz)
        self._opened = ExitStack()
        try:
            self._frames = FrameServer(self.frames_path)
            self._opened.callback(self._frames.close)
            panel = config.lab.monitor
            self._monitor = MonitorPort(self.monitor_path, (panel.width_m, panel.height_m))
            self._opened.callback(self._monitor.close)
            car = vehicle_in_room(config.lab)
            car.reset(*config.start_pose)
            self.vesc = VescEmulator(config.vesc, car, self.vesc_port, run_dir / "vesc_wire.csv")
            self._opened.callback(self.vesc.close)
            self._start(self._run_physics, "twin physics")
            self._start(self._run_camera, "twin camera")
            self._wait_until_ready()
            # Last: who sees poses may count on pictures.
            self.vicon = ViconEmulator(config.vicon, self._subject_poses)
            self._opened.callback(self.vicon.close)
        except BaseException:
            self.close()
            raise

    @property
    def state(self) -> VehicleState:
        """True state of the car now."""
        return self.vesc.state

    @property
    def missed(self) -> dict[str, int]:
        """Number of skipped ticks because a thread was delayed."""
        return {
            "camera": self._camera_pacer.missed,
            "physics": self._physics_pacer.missed,
            "vicon": self.vicon.missed,
        }

    def check(self) -> None:
        """Raise the error that ended a thread of the lab."""
        if self._failure is not None:
            raise self._failure

    def place(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        """Lift the car to a start pose; refused while it moves or a motor command is active."""
        self.vesc.place(x_m, y_m, yaw_rad)
        self._history.clear()

    def close(self) -> None:
        """Stop all threads and remove the link and the socket."""
        self._stop.set()
        self._opened.close()

    def __enter__(self) -> LiveLab:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    def _start(self, run: object, name: str) -> None:
        thread = threading.Thread(target=self._guard, args=(run,), name=name, daemon=True)
        thread.start()
        self._opened.callback(thread.join, timeout=5.0)

    def _guard(self, run: object) -> None:
        try:
            assert callable(run)
            run()
        except Exception as error:  # raised again by check()
            self._failure = error
            self._stop.set()
            self._ready.set()

    def _wait_until_ready(self) -> None:
        if not self._ready.wait(_BUILDING_S):
            raise HardwareError(
                f"expected the simulated lab to render an image within {_BUILDING_S:g} s, got none; does EGL hang? Run advnerf doctor"
            )
        self.check()

    def _run_physics(self) -> None:
        last_ns: int | None = None
        while (tick_ns := self._physics_pacer.wait(self._stop)) is not None:
            step_s = 1.0 / self.config.physics_rate_hz if last_ns is None else (tick_ns - last_ns) / NS_PER_S
            self._history.add(tick_ns, self.vesc.advance(min(step_s, _LONGEST_STEP_S), tick_ns))
            last_ns = tick_ns

    def _run_camera(self) -> None:
        with Lab(self.config.lab) as lab:
            lab.observe(depth=False)  # the first picture pays for compiling shaders
            self._ready.set()
            sequence, last_ns = 0, 0
            camera = ImperfectCamera(self.config.camera_effects, lab.camera_pinhole)

            def drawn(pose: Array) -> Rgb:
                x_m, y_m, yaw_rad = map(float, pose)
                return lab.observe_at(x_m, y_m, yaw_rad, depth=False)[0]

            while (tick_ns := self._camera_pacer.wait(self._stop)) is not None:
                real_ns = tick_ns + time.time_ns() - time.monotonic_ns()
                state = self._history.at(tick_ns, wait_s=0.02) or self.state
                self._light_monitor(lab)
                pose = np.array([state.x_m, state.y_m, state.yaw_rad])
                rgb = camera.see(drawn, pose, (tick_ns - last_ns) / NS_PER_S)
                last_ns = tick_ns
                self._hold_until(tick_ns + round(self.config.camera_latency_s * NS_PER_S))
                if rgb is not None:  # else lost on the way: its number is missing
                    self._frames.publish(Frame(rgb, real_ns, tick_ns, sequence, simulated=True))
                sequence += 1

    def _hold_until(self, mono_ns: int) -> None:
        if (rest_ns := mono_ns - time.monotonic_ns()) > 0:
            self._stop.wait(rest_ns / NS_PER_S)

    def _light_monitor(self, lab: Lab) -> None:
        changed, shown = self._monitor.take()
        if changed:
            lab.show("monitor", shown)

    def _subject_poses(self, mono_ns: int) -> dict[str, Array]:
        # Delayed physics makes poses late, never wrong: an old state with a new stamp would be a car that jumps afterwards.
        state = self._history.at(mono_ns, wait_s=_HELD_UP_S) or self.state
        return {
            "car": np.asarray(state.T_world_from_car),
            "board": self.config.lab.board.T_world_from_face,
            "monitor": self.config.lab.monitor.T_world_from_face,
        }
