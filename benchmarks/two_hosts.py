"""Does the car drive when it should and stop when it must, with the policy on another host? ``python -m benchmarks.two_hosts``.

Two network namespaces joined by a bad cable (`tests.support.live.network`), ``launch/two_hosts.launch.yaml`` with keys in both of them, and
a trained policy that drives at 0.8 m/s. The conditions: a clean link, 5 % of the packets lost each way (with the kernel's TCP as
docs/two_hosts.md sets it for wireless, and as delivered), 300 ms of delay each way, a stall of 2 s, and a workstation whose clock is
50 ms ahead. What counts is what the motor controller reads at its end of the wire.
About four minutes, real time; every finished condition is a file in ``runs/two_hosts``, and only what is missing is run.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from advnerf_core.documents import read_json
from advnerf_core.files import write_atomically
from benchmarks.host_pair import HostPair, Person, skewed_clock, stop_of
from benchmarks.results import REPOSITORY, record_row
from tests.support.live.graph import BrokenPromise
from tests.support.live.network import Cable, available, resend_early, two_hosts

COMMAND = "python -m benchmarks.two_hosts"
FOLDER = REPOSITORY / "runs" / "two_hosts"
POLICY = REPOSITORY / "runs" / "demo" / "policy" / "policy.safetensors"
SPEED_MPS, LIMIT_MS = 0.8, 350.0
DRIVE_S, LOSSY_S, BEFORE_S = 15.0, 40.0, 3.0
LOSS, DELAY_S, STALL_S, SKEW_S = 0.05, 0.3, 2.0, 0.05
REFUSE_S, REST_S = 5.0, 3.0
# A car that drives, rather than one that is armed again and again, covers most of the way.
LOSSY_LEAST_M = 0.7 * SPEED_MPS * LOSSY_S
Result = dict[str, Any]


def _person(pair: HostPair) -> Person:
    assert pair.person is not None
    return pair.person


def _drive(pair: HostPair, duration_s: float) -> tuple[float, list[Result]]:
    """Drive for so long, armed again by the person after each stop; metres driven, and the stops."""
    person, stops, ends = _person(pair), [], time.monotonic() + duration_s
    before = pair.wire()[-1][2] if pair.wire() else 0.0
    while time.monotonic() < ends:
        offset = pair.wire_size()
        person.arm(20.0)
        while person.armed and time.monotonic() < ends:
            person.watch(0.05)
        if not person.armed:
            why = person.reasons[-1][2]
            person.watch(REST_S)  # nobody arms: it must stay where it is
            found = stop_of(pair.wire(offset), person.commands)
            stops.append({**(found or {"by": "disarmed before it moved", "brake_ms": 0.0}), "why": why})
    return pair.wire()[-1][2] - before, stops


def _ask_in_vain(pair: HostPair) -> list[str]:
    """Ask for arming for a while; why it was refused. A `BrokenPromise` if it was not, or if anything moved."""
    person, offset, reasons = _person(pair), pair.wire_size(), []
    asked = len(person.reasons)
    ends = time.monotonic() + REFUSE_S
    while time.monotonic() < ends:
        person.say_arm()
        person.watch(0.25)
    for _, armed, reason in person.reasons[asked:]:
        if armed:
            raise BrokenPromise("it armed")
        if reason.startswith("not armed:") and reason not in reasons:
            reasons.append(reason)
    moves = [row[0] for row in pair.wire(offset) if row[0].name == "SET_RPM"]
    if moves or not reasons:
        raise BrokenPromise(f"{len(moves)} commands to move, refusals {reasons}, {person.describe()}")
    return reasons


def _stop_while_driving(pair: HostPair, break_link: Callable[[], None], watch_s: float) -> Result:
    """Drive, break the link, and see how the car stops and that it stays."""
    person, offset = _person(pair), pair.wire_size()
    person.arm(20.0)
    person.watch(BEFORE_S)
    if not person.armed or pair.wire(offset)[-1][1] < SPEED_MPS / 2:
        raise BrokenPromise(f"it did not drive before the link broke: {person.reasons[-1]}")
    broken_ns = time.monotonic_ns()
    break_link()
    person.watch(watch_s)
    found = stop_of(pair.wire(offset), person.commands)
    if found is None or person.armed:
        raise BrokenPromise(f"it was not stopped within {watch_s:g} s; armed: {person.armed}")
    why = next((r for at, armed, r in person.reasons if at > broken_ns and not armed), "")
    return {**found, "why": why, "after_break_ms": (found["brake_mono_ns"] - broken_ns) / 1e6}


def clean(pair: HostPair) -> Result:
    """A good link: it drives."""
    distance_m, stops = _drive(pair, DRIVE_S)
    return {
        "distance_m": distance_m,
        "stops": stops,
        "met": not stops and distance_m >= 0.8 * SPEED_MPS * DRIVE_S,
        "offset_ms": 1e3 * (_person(pair).offset_s or 0.0),
    }


def loss(pair: HostPair) -> Result:
    """Drive while packets are lost and TCP sends them again: any stop must come in time, and it must get somewhere."""
    pair.cable.loss, lost, carried = LOSS, pair.cable.lost, pair.cable.carried
    distance_m, stops = _drive(pair, LOSSY_S)
    lost, carried = pair.cable.lost - lost, pair.cable.carried - carried
    met = distance_m >= LOSSY_LEAST_M and all(stop["brake_ms"] <= LIMIT_MS for stop in stops)
    return {"distance_m": distance_m, "stops": stops, "lost": lost / max(1, lost + carried), "met": met}


def delay(pair: HostPair) -> Result:
    """A link that becomes slow: every command is too old. It stops, will not arm, and drives when the link is good again."""

    def slow() -> None:
        pair.cable.delay_s = DELAY_S

    found = _stop_while_driving(pair, slow, 4.0)
    found["refusals"] = _ask_in_vain(pair)
    pair.cable.delay_s = 0.0
    _person(pair).watch(REST_S)
    return _and_again(pair, found)


def stall(pair: HostPair) -> Result:
    """Nothing passes for 2 s, and then everything at once: it stops, and stays when the link is back."""
    found = _stop_while_driving(pair, lambda: pair.cable.stall(STALL_S), STALL_S + 4.0)
    return _and_again(pair, found)


def _and_again(pair: HostPair, found: Result) -> Result:
    again_m, stops = _drive(pair, BEFORE_S)
    found |= {"again_m": again_m, "met": found["brake_ms"] <= LIMIT_MS and again_m > 0.5 and not stops}
    return found


def skew(pair: HostPair) -> Result:
    """The workstation's clock is ahead: it will not arm."""
    refusals = _ask_in_vain(pair)
    offset_s = _person(pair).offset_s or 0.0
    moves = sum(row[0].name == "SET_RPM" for row in pair.wire())
    met = moves == 0 and any("clock" in reason for reason in refusals) and abs(offset_s - SKEW_S) < 0.02
    return {"refusals": refusals, "offset_ms": 1e3 * offset_s, "moves": moves, "met": met}


CONDITIONS: dict[str, Callable[[HostPair], Result]] = {
    "clean": clean, "loss": loss, "loss_untuned": loss, "delay": delay, "stall": stall, "skew": skew,
}  # fmt: skip


def measure(name: str, policy: Path, settings: Sequence[str] = ()) -> Result:
    """One condition, on two hosts that are started for it."""
    folder = Path(tempfile.mkdtemp(prefix="advnerf-"))
    with two_hosts(Cable(), seed=len(name)) as cable:
        if name == "loss":
            resend_early(cable)
        try:
            pair = HostPair(
                cable, folder, policy, skewed_clock(folder, SKEW_S) if name == "skew" else None, settings
            )
            try:
                result = CONDITIONS[name](pair)
            finally:
                pair.close()
        except (BrokenPromise, TimeoutError) as error:
            result = {"met": False, "broken": str(error)}
    return {"condition": name, "folder": str(folder), **result}


def run(folder: Path, policy: Path, names: list[str]) -> dict[str, Result]:
    """Every condition that is not there yet."""
    found = {}
    for name in names:
        file = folder / f"{name}.json"
        if not file.exists():
            write_atomically(file, json.dumps(measure(name, policy), indent=1))
        found[name] = read_json(file)
        print(f"{name}: {found[name]}", flush=True)
    return found


def record(found: dict[str, Result]) -> None:
    """Write the rows."""
    how = "netem is not needed: two TUN ends and a thread that carries the packets"
    lossy = f"{LOSS:.0%} of packets lost each way, {LOSSY_S:g} s"
    drives = f">= {LOSSY_LEAST_M:.0f} m; a stop only by age, within {LIMIT_MS:g} ms, and it stays"
    stop = f"brake <= {LIMIT_MS:g} ms after the last fresh command; stays stopped; "
    rows = {
        "clean": ("clean link", "distance_m", "m", f"drives {DRIVE_S:g} s without a stop", how),
        "loss": (f"{lossy}, rto_min 20 ms", "distance_m", "m", drives, "as docs/two_hosts.md advises"),
        "loss_untuned": (
            f"{lossy}, TCP as delivered",
            "distance_m",
            "m",
            drives,
            "the kernel waits 200 ms before it sends again; a command lives for 220 ms",
        ),
        "delay": (
            f"{1e3 * DELAY_S:g} ms of delay each way while driving",
            "brake_ms",
            "ms",
            stop + "refuses to arm",
            "",
        ),
        "stall": (
            f"{STALL_S:g} s stall while driving",
            "brake_ms",
            "ms",
            stop + "drives when armed again",
            "",
        ),
        "skew": (
            f"{1e3 * SKEW_S:g} ms of clock skew",
            "moves",
            "commands to move",
            "0: refuses to arm",
            "the workstation's processes get a moved CLOCK_REALTIME by LD_PRELOAD",
        ),
    }
    for name, result in found.items():
        line, key, unit, target, note = rows[name]
        value = result.get(key)
        notes = [note, result.get("broken", ""), _words(result)]
        record_row(
            f"two hosts: {line}",
            "-" if value is None else round(value, 2 if unit == "m" else 0),
            unit,
            target,
            result["met"],
            COMMAND,
            "; ".join(filter(None, notes))[:400],
        )


def _words(result: Result) -> str:
    """What else was seen."""
    stops = result.get("stops")
    words = [] if stops is None else [f"{len(stops)} stops"]
    words += [f"after {stop['brake_ms']:.0f} ms: {stop['why']}" for stop in stops or []]
    if "again_m" in result:
        words += [
            f"by: {result['why']}; {result['distance_m']:.2f} m to standstill",
            "drove again when a person armed",
        ]
    return "; ".join([*words, *result.get("refusals", [])[:2]])


def main() -> int:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--policy", type=Path, default=POLICY, help="the policy that drives")
    parser.add_argument("--only", choices=list(CONDITIONS), action="append", help="this condition alone")
    parser.add_argument("--trial", action="store_true", help="in a folder of its own, nothing is recorded")
    options = parser.parse_args()
    if not available():
        print("this needs root, /dev/net/tun and iproute2: run it in a container with --cap-add NET_ADMIN")
        return 2
    if not options.policy.exists():
        print(f"no policy {options.policy}; make experiment leaves one, or name another with --policy")
        return 2
    folder = Path(tempfile.mkdtemp(prefix="two-hosts-")) if options.trial else FOLDER
    found = run(folder, options.policy, options.only or list(CONDITIONS))
    if not options.trial:
        record(found)
    return 0 if all(result["met"] for result in found.values()) else 1


if __name__ == "__main__":
    raise SystemExit(main())
