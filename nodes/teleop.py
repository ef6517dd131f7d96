"""The teleop node: repeatedly publishes the operator's input from a gamepad or keyboard.

The safety node lets the car move only while a button is held (``safety.teleop: hold``). If this node stops publishing, the button
counts as released. Left shoulder button (or w, a, d, s): the operator drives. Right one (or o): the software drives. Both: the
operator drives.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from pydantic import Field

from advnerf_core.strict import StrictModel
from hardware.operator.gamepad import EVENT_LAYOUT, JS_LAYOUT, Gamepad, GamepadLayout
from hardware.operator.hands import Hands
from hardware.operator.keyboard import Keyboard
from nodes.runtime.arm_asker import ArmAsker
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import header, types
from nodes.runtime.node import (
    ACTIVE,
    FAULT,
    READY,
    Inbox,
    MessageInfo,
    Node,
    NodeContext,
    Now,
    Out,
    ReaderThread,
)
from nodes.runtime.process import run_node_main

_STALE_S = 0.15
_REFUSED_S = 0.3  # the safety node arms within a few milliseconds of a press


class TeleopConfig(StrictModel):
    """Configuration of the teleop node.

    Attributes:
        device: ``keyboard``, or the device file of a gamepad, preferably under ``/dev/input/by-id``.
        axes: Numbers of the throttle and steering axes, if they are not the usual ones.
        speed_mps: Speed at full throttle [m/s].
        steering_rad: Steering at full deflection [rad].
    """

    device: Path | Literal["keyboard"] = "keyboard"
    axes: tuple[int, int] | None = None
    speed_mps: float = Field(default=0.8, gt=0.0, le=2.0)
    steering_rad: float = Field(default=0.25, gt=0.0, le=0.4)


class TeleopNode(Node):
    """Publishes the state of the operator's input.

    Args:
        read: Blocks for a bounded time and returns the input.
    """

    opens = "a keyboard or gamepad"
    subscriptions = ("/safety/state", "/motor/sent")
    publications = ("/teleop/state", "/arm")
    tick_rate_hz = 20.0

    def __init__(
        self, config: TeleopConfig, read: Callable[[], Hands | None], release: Callable[[], None]
    ) -> None:
        self._config, self._release = config, release
        self.inbox: Inbox[Hands] = Inbox(capacity=4)
        self._hands, self._heard_ns = Hands(connected=False, text="not read yet"), 0
        self._stops = self._rearms = 0
        self._estop = False
        self._arm_in_ticks = 0
        self._asker, self._late = ArmAsker(), ""
        self._mode, self._held_ns = "idle", 0
        self._unarmed = self._told_unarmed = ""
        self._reader = ReaderThread(read, self.inbox, "hands")
        self._reader.start()

    @classmethod
    def build(cls, config: TeleopConfig, context: NodeContext) -> TeleopNode:
        """Build the node. Its keyboard is the terminal in which it was started."""
        device: Keyboard | Gamepad
        if config.device == "keyboard":
            device = Keyboard(sys.stdin.fileno(), time.monotonic_ns)
        else:
            path = Path(config.device)
            device = Gamepad(path, time.monotonic_ns, _layout(path, config.axes))
        return cls(config, device.read, device.close)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Check whether the safety node has answered a request, why the car is not armed, and whether it brakes."""
        if topic == "/motor/sent":
            self._asker.heard_motor(message, info)
        else:
            self._asker.heard(message, info)
            self._unarmed = "" if message.armed else message.reason
        return []

    def receive(self, item: Hands, now: Now) -> list[Out]:
        """Note the operator's input. A change is published at once. An e-stop also disarms, and is repeated until it is confirmed."""
        self._hands, self._heard_ns, before = item, now.mono_ns, (self._mode, self._estop)
        if item.rearms > self._rearms:
            self._estop, self._arm_in_ticks = False, 2
        outs = []
        if item.stops > self._stops:
            self._estop, self._arm_in_ticks = True, 0  # if both are pressed, the stop wins
            outs.append(self._asker.disarm(now, "e-stop of the teleop node"))
        self._stops, self._rearms = item.stops, item.rearms
        state = self._state(now)
        return [state, *outs] if (self._mode, self._estop) != before else outs

    def tick(self, now: Now) -> list[Out]:
        """Publish the state again. Re-arm a moment after the e-stop was reported as released, because they use different topics.

        A request is repeated until the safety node has answered. A request to re-arm also ends when it is too old.
        """
        self._say_late(now)
        self._say_unarmed(now)
        if self._arm_in_ticks:
            self._arm_in_ticks -= 1
            if not self._arm_in_ticks:
                self._asker.arm(now, "re-armed by the operator")
        return [self._state(now), *self._asker.tick(now)]

    def status(self) -> tuple[str, str]:
        """Report active while a button is held."""
        if self._late:
            return FAULT, self._late
        if not self._hands.connected:
            return FAULT, self._hands.text
        if self._estop:
            return READY, f"{self._hands.text}: e-stop, re-arm to continue"
        return (ACTIVE if self._mode != "idle" else READY), f"{self._hands.text}: {self._mode}"

    def close(self) -> None:
        """Release the device."""
        self._reader.stop()
        self._release()

    def _say_late(self, now: Now) -> None:
        """Say in the terminal or the log when a stop is not confirmed, and when it is."""
        before, self._late = self._late, self._asker.not_confirmed(now)
        if bool(before) != bool(self._late):
            print(f"teleop: {self._late or 'the car is stopped'}", file=sys.stderr, flush=True)

    def _say_unarmed(self, now: Now) -> None:
        """Say in the terminal or the log why the car does not move although a button is held; each reason once a press."""
        if self._mode == "idle" or self._estop:
            self._held_ns, self._told_unarmed = now.mono_ns, ""
            return
        held_s = (now.mono_ns - self._held_ns) / NS_PER_S
        if held_s > _REFUSED_S and self._unarmed not in ("", self._told_unarmed):
            self._told_unarmed = self._unarmed
            print(f"teleop: the car does not drive: {self._unarmed}", file=sys.stderr, flush=True)

    def _state(self, now: Now) -> Out:
        hands, config = self._hands, self._config
        # If the reader hangs, the button must count as released.
        fresh = hands.connected and now.mono_ns - self._heard_ns <= _STALE_S * NS_PER_S
        self._mode = (
            ("human" if hands.human else "autonomy" if hands.autonomy else "idle") if fresh else "idle"
        )
        drives = self._mode == "human" and not self._estop
        message = types.Teleop(
            header=header(now.real_ns),
            mode=self._mode,
            estop=self._estop,
            speed_mps=config.speed_mps * hands.throttle if drives else 0.0,
            steering_rad=config.steering_rad * hands.steering if drives else 0.0,
            device=hands.text,
        )
        return Out("/teleop/state", message)


def _layout(path: Path, axes: tuple[int, int] | None) -> GamepadLayout | None:
    if axes is None:
        return None
    usual = JS_LAYOUT if path.name.startswith("js") else EVENT_LAYOUT
    return replace(usual, throttle=axes[0], steering=axes[1])


if __name__ == "__main__":
    raise SystemExit(run_node_main(TeleopConfig, TeleopNode.build))
