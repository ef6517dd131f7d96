"""Classifies why a drive ended: by the driving or a person, or by a fault of the node graph. Pure; reads only the safety node's reason.

A stop that an attack can cause, and a stop by a person, is a result. Every other reason, also one that is not known here, is a fault:
it says that a node, a sensor or a clock failed, and nothing about the policy.
"""

from __future__ import annotations

import re

from hardware.motor.vesc_replies import FAULT_NAMES, OVER_CURRENT
from nodes.control.arming_gates import NOT_HELD
from nodes.runtime.clock import NS_PER_S

# The texts of `arming`, `arming_gates`, `stall_check` and the safety node. A car that does not move, or whose motor draws too much
# current, has run into something. A command out of range is the policy's answer to an image.
_RESULT = re.compile(
    r"the car is outside the fence|the car is [\d.]+ m from the fence|stalled for |"
    r"a command of |a command that is not finite|"
    rf"node motor is in state fault: latched: the VESC reports a fault: {FAULT_NAMES[OVER_CURRENT]}|"
    rf"disarmed by |e-stop pressed|the e-stop is pressed|{NOT_HELD}|the trial is over|the trial was ended"
)
_STALLED = "stalled for "
# The safety node states ten times a second whether the car is armed [s].
SAFETY_SILENT_S = 0.5


def is_result(stopped: str) -> bool:
    """Whether a stop belongs to the drive.

    Args:
        stopped: Why the safety node disarmed; empty for a drive that was not stopped.
    """
    return not stopped or _RESULT.match(stopped) is not None


def is_stall(stopped: str) -> bool:
    """Whether the car was commanded to move and stood still."""
    return stopped.startswith(_STALLED)


def safety_silence(last_ns: int, now_ns: int) -> str:
    """Why a drive ended at the safety node's last report of an armed car, if the next one did not follow; empty if it did.

    Args:
        last_ns: Time of that report [ns].
        now_ns: Time of the next one, or the present [ns].
    """
    silent_s = (now_ns - last_ns) / NS_PER_S
    return f"no message from the safety node for {silent_s:.1f} s" if silent_s > SAFETY_SILENT_S else ""
