"""The compositor shows an attack only while the safety node says, freshly, that the car is armed."""

import importlib.util
from pathlib import Path

import pytest

from nodes.runtime.messages import decode, encode, header, types
from nodes.runtime.wire import MessageInfo
from tests.support.messages import filled

pytestmark = pytest.mark.live

# Import mode importlib: the bench of the compositor's own tests by its path.
_SPEC = importlib.util.spec_from_file_location(
    "compositor_bench", Path(__file__).with_name("test_compositor.py")
)
bench_of = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(bench_of)


def say(bench, armed):
    state = filled(
        types.SafetyState,
        armed=armed,
        stopping=not armed,
        reason="" if armed else "the car is outside the fence",
    )
    now = bench.clock.now()
    info = MessageInfo(now.mono_ns, now.mono_ns, instance_id=1)
    message = decode("advnerf_msgs/msg/SafetyState", encode(state))
    bench.node.handle("/safety/state", message, info, now)


def drawn(bench, t_s):
    bench.poses(t_s - 0.01)
    bench.image(t_s)
    bench.poses(t_s + 0.01)
    return bench.labels()[-1].drawn, bench.labels()[-1].reason


def test_nothing_is_drawn_unless_armed_and_fresh():
    bench = bench_of.Bench(bench_of.node_of(bench_of.attack(), interlock=True))
    assert "/safety/state" in bench.node.subscriptions
    assert drawn(bench, 0.0) == (False, "interlock: no message from the safety node")
    say(bench, True)
    assert drawn(bench, 0.1) == (True, "")
    say(bench, False)
    assert drawn(bench, 0.2) == (False, "interlock: not armed: the car is outside the fence")
    say(bench, True)
    assert drawn(bench, 0.3)[0]
    bench.clock.advance(0.6)
    assert drawn(bench, 0.4) == (False, "interlock: no message from the safety node")
    assert len(bench.images()) == 5  # what may not be drawn on passes unchanged: the policy still sees


def switch(bench, show_it):
    now = bench.clock.now()
    message = types.AttackSwitch(header=header(now.real_ns), show=show_it, source="ann")
    bench.node.handle("/attack/switch", message, MessageInfo(now.mono_ns, now.mono_ns, instance_id=1), now)


def test_the_operator_switches_the_attack_off_and_on_but_never_past_the_interlock():
    bench = bench_of.Bench(bench_of.node_of(bench_of.attack(), interlock=True))
    say(bench, True)
    assert drawn(bench, 0.1) == (True, "")
    switch(bench, False)
    assert drawn(bench, 0.2) == (False, "switched off by ann")
    switch(bench, True)
    assert drawn(bench, 0.3) == (True, "")
    say(bench, False)
    switch(bench, True)
    assert drawn(bench, 0.4) == (False, "interlock: not armed: the car is outside the fence")
