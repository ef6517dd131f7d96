"""The commands ``advnerf car motor ...``, for the motor controller and the steering check."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import FAILURE_EXIT, RunDir, fail_unless, print_table, table

if TYPE_CHECKING:
    from nodes.runtime.bus import Bus, Received
    from nodes.runtime.clock import Now
    from nodes.runtime.requests import RequestIdentity

app = CommandGroup(
    no_args_is_help=True, help="Inspect the motor controller, set its timeout, check the steering."
)
Port = Annotated[
    str, typer.Option("--vesc", help="Serial device of the VESC. Stop the launch that uses it first.")
]
_CHECK_S, _ANSWER_S = 75.0, 3.0


@app.command("info")
def info(port: Port = "/dev/vesc") -> None:
    """Show the controller's firmware, telemetry, and the timeout after which it stops the car."""
    from hardware.errors import LinkTimeout, ProtocolError
    from hardware.motor.limits import DriveLimits, VehicleGains
    from hardware.motor.vesc import Vesc

    vesc = Vesc(port, VehicleGains(), DriveLimits())
    vesc.open()
    try:
        firmware, values = vesc.identify(), vesc.read_values(0.5)
        try:
            timeout = str(vesc.read_timeout())
        except (LinkTimeout, ProtocolError) as error:
            timeout = f"unknown: {error}"
    finally:
        vesc.abandon()  # this command sent no motor command, so there is nothing to stop
    rows = table("what", "value")
    for what, value in (
        ("controller", str(firmware)),
        ("telemetry", f"generation {values.generation}"),
        ("timeout", timeout),
        ("supply", f"{values.v_in:.1f} V"),
        ("motor", f"{values.erpm:.0f} erpm, {values.motor_current_a:.2f} A"),
        ("used", f"{values.used_ah:.3f} Ah, {values.used_wh:.2f} Wh"),
        ("fault", values.fault_name),
    ):
        rows.add_row(what, value)
    print_table(rows)


@app.command("set-timeout")
def set_timeout(
    timeout_ms: Annotated[
        int,
        typer.Option(min=50, max=2000, help="Time without commands after which the controller brakes [ms]."),
    ] = 250,
    brake_current_a: Annotated[
        float, typer.Option("--brake-current", min=0.0, max=60.0, help="Amperes.")
    ] = 20.0,
    port: Port = "/dev/vesc",
) -> None:
    """Store timeout and brake current in the controller and read them back. The motor must stand still."""
    from hardware.motor.limits import DriveLimits, VehicleGains
    from hardware.motor.vesc import Vesc
    from hardware.motor.vesc_settings import TimeoutSettings

    vesc = Vesc(port, VehicleGains(), DriveLimits())
    vesc.open()
    try:
        firmware = vesc.identify()
        before = vesc.read_timeout()
        after = vesc.set_timeout(TimeoutSettings(timeout_ms, brake_current_a))
    finally:
        vesc.abandon()
    print(f"{firmware}: timeout was {before}, is {after}")


@app.command("check-steering")
def check_steering(
    run_dir: RunDir = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask; confirm that the wheels turned.")] = False,
) -> None:
    """Turn the front wheels left, then right. Motion capture or you must confirm that they turned."""
    from nodes.launching.watching import find_run_dir
    from nodes.runtime.bus import Bus

    with Bus(find_run_dir(run_dir)) as bus:
        _ask_motor(bus, "start")
        asked, shown, began = False, "", time.monotonic()
        while time.monotonic() - began < _CHECK_S:
            bus.wait(0.2)
            for received in bus.receive():
                row = _steering_row(received)
                if row is None:
                    continue
                if row.message != shown:
                    shown = str(row.message)
                    print(shown, flush=True)
                if shown.endswith("confirm or deny") and not asked:
                    asked = True
                    turned = yes or typer.confirm("did the front wheels turn left, then right?")
                    _ask_motor(bus, "confirm" if turned else "deny")
                elif not shown.startswith("steering check:"):
                    fail_unless(shown.startswith(("steering seen", "steering confirmed")))
                    return
    print("no answer from the motor node; is it running?")
    raise typer.Exit(FAILURE_EXIT)


def _ask_motor(bus: Bus, action: str) -> None:
    """Repeat a request about the steering check until the motor node answers. A refusal raises `LaunchError`."""
    from nodes.runtime.asking import NoAnswerError, ask
    from nodes.runtime.errors import LaunchError
    from nodes.runtime.messages import header, types

    def make(asked: RequestIdentity, now: Now) -> Any:
        return types.SteeringCheck(
            header=header(asked.real_ns), action=action, source="operator", ask_id=asked.ask_id
        )

    def read(ask_id: str, received: Received) -> dict[str, str] | None:
        row = _steering_row(received)
        values = {} if row is None else {str(pair.key): str(pair.value) for pair in row.values}
        return values if values.get("answered") == ask_id else None

    try:
        answer = ask(bus, "/motor/check", make, "/diagnostics", read, every_s=0.1, patience_s=_ANSWER_S)
    except NoAnswerError:
        raise LaunchError(
            f"expected an answer from the motor node within {_ANSWER_S:g} s, got none; is it running?"
        ) from None
    if answer["granted"] != str(True):
        raise LaunchError(f"the motor node refused to {action} the steering check: {answer['answer']}")


def _steering_row(received: Received) -> Any:
    return next((row for row in received.message().status if row.name == "motor: steering"), None)
