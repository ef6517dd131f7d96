"""The monitor node: shows the attack on a real screen in true size, only while the safety node allows it.

The face is a square in the centre of the panel; the rest is black. The face is plain unless a fresh message of the safety node says
that the car is armed. After every change the screen is read back, and wrong pixels end the node. New attacks are received over the
bus as by the compositor. A refused one changes nothing.
"""

from __future__ import annotations

import hashlib
import time
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.strict import StrictModel
from calibration.panel import MonitorPanel, make_panel, require_fits
from calibration.schema import TargetCalibration, load_calibration
from hardware.errors import HardwareError
from hardware.screen.display import Display, PygameDisplay, TwinDisplay
from hardware.screen.edid import edid_of
from nodes.control.attack_receiver import ATTACK_FILE, AttackReceiver
from nodes.control.interlock import ATTACK_SWITCH, SAFETY_STATE, AttackSwitch
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import header, types
from nodes.runtime.node import ACTIVE, READY, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main

_SAY_S = 0.2
_PLAIN_PX = 8
Colour = tuple[float, float, float]


class MonitorOutputConfig(StrictModel):
    """A real screen.

    Attributes:
        index: Index of the screen in the window system.
        connector: Connector of the monitor (``HDMI-A-1``), for its EDID; None relies on the measured corners.
    """

    kind: Literal["screen"] = "screen"
    index: int = Field(default=0, ge=0)
    connector: str | None = None


class TwinScreenConfig(StrictModel):
    """The monitor of the simulated lab.

    Attributes:
        path: Socket of the simulated lab's monitor.
        wait_s: Longest time for the twin to build its world [s].
    """

    kind: Literal["twin"] = "twin"
    path: Path
    wait_s: float = Field(default=30.0, ge=0.0)


class MonitorConfig(StrictModel):
    """Configuration of the monitor node.

    Attributes:
        attack: Attack file to show; empty for none.
        target: Calibration file with the corners of the whole panel.
        display: The screen.
        size_mm: Measured width and height of the picture, instead of those in the EDID [mm].
        plain_rgb: Colour of the face without an attack, 0..1.
        face_m: Side of the plain face without an attack; None uses the centre square [m].
        interlock: Show the attack only while the safety node reports that the car is armed.
        state_age_s: Largest age of the safety node's state [s].
    """

    attack: Path | None = None
    target: Path
    display: Annotated[MonitorOutputConfig | TwinScreenConfig, Field(discriminator="kind")] = (
        MonitorOutputConfig()
    )
    size_mm: tuple[float, float] | None = None
    plain_rgb: Colour = (0.20, 0.62, 0.28)
    face_m: float | None = Field(default=None, gt=0.0)
    interlock: bool = True
    state_age_s: float = Field(default=0.5, gt=0.0, le=2.0)

    @field_validator("attack", mode="before")
    @classmethod
    def _empty_is_none(cls, value: Any) -> Any:
        return None if value == "" else value

    @field_validator("size_mm")
    @classmethod
    def _a_size(cls, size: tuple[float, float] | None) -> tuple[float, float] | None:
        if size is not None and min(size) <= 0.0:
            raise ValueError(f"expected a width and a height > 0 mm, got {size}")
        return size

    @field_validator("plain_rgb")
    @classmethod
    def _a_colour(cls, rgb: Colour) -> Colour:
        if not all(0.0 <= value <= 1.0 for value in rgb):
            raise ValueError(f"expected three values from 0 to 1, got {rgb}")
        return rgb


class MonitorNode(Node):
    """Shows the attack or the plain face. See the module's docstring.

    Args:
        display: The open screen, which the node closes.
    """

    opens = "a screen"
    publications = ("/monitor/attack", "/monitor/shown")
    tick_rate_hz = 20.0

    def __init__(
        self,
        config: MonitorConfig,
        display: Display,
        panel: MonitorPanel,
        target: TargetCalibration,
        attack: AttackFile | None,
    ) -> None:
        self._display, self._panel = display, panel
        self._interlock, self._state_age_ns = config.interlock, round(config.state_age_s * NS_PER_S)
        self.subscriptions = (ATTACK_FILE, ATTACK_SWITCH, *((SAFETY_STATE,) if config.interlock else ()))
        self._switch = AttackSwitch()
        plain = np.round(255.0 * np.array(config.plain_rgb))
        self._plain = np.full((_PLAIN_PX, _PLAIN_PX, 3), plain, np.uint8)
        self._face_m = min(config.face_m or panel.square_m, panel.square_m)
        self._received = AttackReceiver(partial(_fitting, panel=panel, target=target))
        self._armed, self._safety_reason, self._state_ns = False, "not armed since the start", -1
        self._changes = 0
        self._attack: AttackFile | None = None
        self._pictures: dict[bool, NDArray[np.uint8]] = {}
        self._showing: bool | None = None
        self._sha256, self._show_ms, self._said_ns = "", 0.0, 0
        self._load(None if attack is None else _fitting(attack, panel, target))

    @classmethod
    def build(cls, config: MonitorConfig, context: NodeContext) -> MonitorNode:
        """Open the screen and read the files."""
        target = load_calibration(TargetCalibration, config.target)
        attack = None if config.attack is None else load_attack(config.attack)
        display = _open(config.display)
        try:
            said = config.size_mm or (display.edid.size_mm if display.edid else None)
            if config.size_mm:
                panel = MonitorPanel(
                    display.size_px, (config.size_mm[0] / 1000.0, config.size_mm[1] / 1000.0)
                )
            else:
                panel = make_panel(display.size_px, target, said)
            return cls(config, display, panel, target, attack)
        except BaseException:
            display.close()
            raise

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Apply the state of the safety node or the operator's switch at once, or handle a piece of a new attack."""
        if topic == SAFETY_STATE:
            self._armed, self._safety_reason = bool(message.armed), str(message.reason)
            self._state_ns = info.publish_mono_ns
        elif topic == ATTACK_SWITCH:
            self._switch.heard(message, now.real_ns)
        elif (attack := self._received.heard(message, info)) is not None:
            # Show the plain face first. `_update` then shows the new attack if allowed.
            self._load(attack)
        return self._update(now)

    def tick(self, now: Now) -> list[Out]:
        """Check the age of the safety node's state and the screen, and publish what is shown."""
        self._display.keep_alive()
        outs = self._update(now)
        if not outs and now.mono_ns - self._said_ns >= _SAY_S * NS_PER_S:
            outs = self._say(now)
        return outs

    def status(self) -> tuple[str, str]:
        """Report active while the attack is on the screen."""
        name = f"attack {self._attack.attack_id}" if self._attack else "no attack file"
        text = name if self._showing else f"plain face ({self._reason}); {name}"
        return (ACTIVE if self._showing else READY), "; ".join(filter(None, (text, self._received.trouble)))

    def counters(self) -> dict[str, float]:
        """Report shown pictures, accepted and refused attacks, and the duration of the last change."""
        return {
            "shown": self._changes,
            "attacks_taken": self._received.taken,
            "attacks_refused": self._received.refused,
            "show_ms": self._show_ms,
        }

    def close(self) -> None:
        """Clear and close the screen."""
        self._display.close()

    def _granted(self, now: Now) -> str:
        """Return why the attack may not be shown now; empty if it may."""
        if self._attack is None:
            return "no attack file"
        if refusal := self._switch.refusal():
            return refusal
        if not self._interlock:
            return ""
        if self._state_ns < 0 or now.mono_ns - self._state_ns > self._state_age_ns:
            return "no message from the safety node"
        return "" if self._armed else f"not armed: {self._safety_reason}"

    def _update(self, now: Now) -> list[Out]:
        self._reason = self._granted(now)
        if self._showing is (not self._reason):
            return []
        self._put(not self._reason)
        return self._say(now)

    def _put(self, attacking: bool) -> None:
        picture = self._pictures[attacking]
        self._show_ms = 1e3 * self._display.show(picture)
        seen = self._display.read_back()
        if not np.array_equal(seen, picture):
            wrong = int((seen != picture).any(axis=-1).sum()) if seen.shape == picture.shape else picture.size
            raise HardwareError(
                f"expected the screen to hold the shown pixels, but {wrong} differ; switch off its colour management, scaling and "
                "night light"
            )
        self._sha256 = hashlib.sha256(np.ascontiguousarray(seen).tobytes()).hexdigest()
        self._showing = attacking
        self._changes += 1

    def _say(self, now: Now) -> list[Out]:
        self._said_ns = now.mono_ns
        attack_id, attacking = self._attack.attack_id if self._attack else "", bool(self._showing)
        head = header(now.real_ns, "monitor")
        shown = types.DisplayShown(
            header=head,
            attack_id=attack_id,
            attacking=attacking,
            reason=self._reason,
            sha256=self._sha256,
            width=self._panel.size_px[0],
            height=self._panel.size_px[1],
            show_ms=self._show_ms,
        )
        label = types.AttackStamp(header=head, attack_id=attack_id, drawn=attacking, reason=self._reason)
        return [Out("/monitor/attack", label), Out("/monitor/shown", shown)]

    def _load(self, attack: AttackFile | None) -> None:
        face = None if attack is None else attack.required_face()
        size = (self._face_m, self._face_m) if face is None else face.size_m
        self._pictures = {False: self._panel.picture(self._plain, size)}
        if face is not None:
            self._pictures[True] = self._panel.picture(face.texture, size)
        self._attack = attack
        self._reason = "" if attack else "no attack file"
        self._put(False)


def _fitting(attack: AttackFile, panel: MonitorPanel, target: TargetCalibration) -> AttackFile:
    require_fits(attack, panel, target)
    return attack


def _open(config: MonitorOutputConfig | TwinScreenConfig) -> Display:
    if isinstance(config, TwinScreenConfig):
        deadline = time.monotonic() + config.wait_s
        while not config.path.exists() and time.monotonic() < deadline:
            time.sleep(0.05)
        return TwinDisplay(config.path)
    edid = None if config.connector is None else edid_of(config.connector)
    return PygameDisplay(config.index, edid.size_px if edid else None, edid)


if __name__ == "__main__":
    raise SystemExit(run_node_main(MonitorConfig, MonitorNode.build))
