"""Does the car stop when the operator's page goes? 100 times each in full.

The robot and the phone are two hosts with a network between them (two namespaces, see `tests.support.live.network`). The phone is Chromium
with the page over TLS, opened with the one-time code. While its operator holds the button and the twin drives at 0.8 m/s, the page is
closed, the browser is killed, the page is stalled, the network is cut, or the network holds all packets for two seconds and then
delivers them. What counts is what the motor controller reads: the time to the first brake command, and no command to move afterwards.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from advnerf_core.geometry import planar_pose
from nodes.runtime.messages import pose_message
from tests.campaigns.campaign import Campaign
from tests.support.live.graph import START, BrokenPromise
from tests.support.live.network import ADDRESSES, Cable, available, two_hosts
from tests.support.live.operator import LiveOperator
from tests.support.live.page_browser import PHONE, Phone, live_page
from tests.support.live.page_browser import available as browser_available

DRIVE_S, WATCH_S, LATE_S = 0.8, 0.9, 2.0
BRAKE_LIMIT_MS = 350.0
# A small network's way there and back takes this long twice [s].
DELAY_S = 0.004
PAGE_PORT = 8443
# Fewer pixels than a phone has: no graphics card draws them here.
_PHONE = {**PHONE, "device_scale_factor": 1}
_TRIES = 100  # on a busy computer the safety node stops the car now and then
_STALL = (
    "() => setTimeout(() => { const end = performance.now() + 1500; while (performance.now() < end); }, 0)"
)


class Bench:
    """Robot, phone, network, and the one who watches the wire."""

    def __init__(self, playwright: Any, operator: LiveOperator, cable: Cable) -> None:
        self._playwright, self.operator, self.cable = playwright, operator, cable
        self.phone: Phone | None = None
        self.lost = 0

    def ready(self) -> Phone:
        """A phone whose operator has control, and the car at the start."""
        if self.phone is None:
            self.phone = Phone(self._playwright, self.operator.run_dir, self.cable.inside(1), _PHONE)
        if self.phone.page is None:
            self.phone.open()
            self.phone.take()
        self._put_back()
        return self.phone

    def drive(self) -> None:
        """Hold the button until the car has driven for a while. A stop without a fault is counted, and tried again."""
        for _ in range(_TRIES):
            phone = self.ready()
            phone.hold()
            try:
                self.operator.wait_until(lambda: self.operator.armed, 5.0, "to arm")
            except TimeoutError:
                pass
            else:
                self.operator.watch(DRIVE_S)
                if self.operator.armed:
                    return
                self.lost += 1
            phone.let_go()
            self.operator.watch(0.5)
        raise BrokenPromise(f"the car would not drive: {self.operator.describe()}")

    @property
    def ready_phone(self) -> Phone:
        """The phone that holds now."""
        assert self.phone is not None
        return self.phone

    def forget_page(self) -> None:
        """The page is gone or useless."""
        if self.phone is not None and self.phone.page is not None:
            self.phone.page.close()
            self.phone.page = None

    def forget_phone(self) -> None:
        """The browser is gone."""
        if self.phone is not None:
            self.phone.close()
            self.phone = None

    def _put_back(self) -> None:
        operator = self.operator
        resets = sum(event.name == "PLACED" for event, *_ in operator.wire())

        def placed() -> bool:
            operator.bus.publish("/twin/reset", pose_message(planar_pose(*START), time.time_ns()))
            operator.watch(0.1)
            return sum(event.name == "PLACED" for event, *_ in operator.wire()) > resets

        operator.wait_until(placed, 10.0, "to put the car back")


def page_closed(bench: Bench) -> int:
    phone, began_ns = bench.ready_phone, time.monotonic_ns()
    phone.page.close()
    phone.page = None
    return began_ns


def browser_killed(bench: Bench) -> int:
    began_ns = time.monotonic_ns()
    bench.ready_phone.kill()
    return began_ns


def page_stalled(bench: Bench) -> int:
    began_ns = time.monotonic_ns()
    bench.ready_phone.page.evaluate(_STALL)
    return began_ns


def network_cut(bench: Bench) -> int:
    began_ns = time.monotonic_ns()
    bench.cable.loss = 1.0
    return began_ns


def network_late(bench: Bench) -> int:
    began_ns = time.monotonic_ns()
    bench.cable.stall(LATE_S)
    return began_ns


def _mended(bench: Bench, fault: str) -> None:
    """Undo a fault, and see that nothing which comes late moves the car."""
    bench.cable.loss = 0.0
    if fault == "network late":
        bench.operator.watch(LATE_S - WATCH_S + 0.5)
    if fault == "page stalled":
        bench.operator.watch(1.0)
        bench.ready_phone.let_go()
    if fault == "network cut":
        bench.operator.watch(0.5)
    if fault == "browser killed":
        bench.forget_phone()
    elif fault != "page stalled":
        bench.forget_page()


FAULTS: dict[str, Callable[[Bench], int]] = {
    "page closed": page_closed,
    "browser killed": browser_killed,
    "page stalled": page_stalled,
    "network cut": network_cut,
    "network late": network_late,
}


def measure(bench: Bench, fault: str) -> float:
    """Drive, let one thing happen, and return the time to the first brake command at the controller [ms]."""
    bench.drive()
    since_ns = FAULTS[fault](bench)
    bench.operator.watch(WATCH_S)
    _mended(bench, fault)
    events = bench.operator.commands_after(since_ns)
    stop = next((event for event in events if event.name in ("SET_CURRENT_BRAKE", "TIMEOUT")), None)
    if stop is None:
        raise BrokenPromise(f"{fault}: nothing told the controller to stop; it read {events[-5:]}")
    if moves := [event for event in events if event.name == "SET_RPM" and event.mono_ns > stop.mono_ns]:
        raise BrokenPromise(f"{fault}: {len(moves)} commands to move came after the stop")
    return (stop.mono_ns - since_ns) / 1e6


@pytest.fixture(scope="module")
def bench() -> Iterator[Bench]:
    """Robot and phone as two hosts."""
    if not (available() and browser_available()):
        pytest.skip("needs root, /dev/net/tun, iproute2, chromium and playwright")
    from playwright.sync_api import sync_playwright

    with (
        two_hosts(Cable(delay_s=DELAY_S)) as cable,
        live_page("record=false", inside=cable.inside(0), host=ADDRESSES[0], port=PAGE_PORT) as operator,
        sync_playwright() as playwright,
    ):
        bench = Bench(playwright, operator, cable)
        yield bench
        bench.forget_phone()


@pytest.mark.campaign
@pytest.mark.parametrize("fault", FAULTS)
def test_the_car_stops_when_the_page_goes(campaign: Campaign, bench: Bench, fault: str) -> None:
    before, found = bench.lost, []
    for _ in range(campaign.size(1, 100)):
        found.append(measure(bench, fault))
        print(f"{fault} {len(found)}: {found[-1]:.0f} ms", flush=True)
    in_time, lost = sum(value <= BRAKE_LIMIT_MS for value in found), bench.lost - before
    campaign.record(
        f"brake at the controller within {BRAKE_LIMIT_MS:g} ms, operator page: {fault}",
        in_time,
        f"of {len(found)}",
        f"{len(found)} of {len(found)}",
        in_time == len(found),
        f"median {float(np.median(found)):.0f} ms, worst {max(found):.0f} ms; {lost} stops without a fault in "
        f"{len(found) + lost} drives; no command to move afterwards",
    )
    assert in_time == len(found)
