"""The commands ``advnerf car ...``: what is done with the car, its devices and a running launch."""

from __future__ import annotations

from nodes.cli import arm, calibrate, camera, keys, motor, node, page, teleop, topic, trial
from nodes.cli.panels import in_panels
from nodes.runtime.options import CommandGroup

app = CommandGroup(
    no_args_is_help=True,
    cls=in_panels(
        {
            "Drive": ("arm", "disarm", "teleop", "trial"),
            "A running launch": ("page", "topic", "top", "keys"),
            "Devices": ("calibrate", "camera", "motor"),
        }
    ),
    help="Arm and drive the car, measure trials, watch a running launch, calibrate, test its devices.",
)
app.command("arm")(arm.arm)
app.command("disarm")(arm.disarm)
app.command("teleop")(teleop.teleop)
app.command("trial")(trial.trial)
app.command("page")(page.page)
app.command("top")(node.top)
app.add_typer(topic.app, name="topic")
app.add_typer(keys.app, name="keys")
app.add_typer(calibrate.app, name="calibrate")
app.add_typer(camera.app, name="camera")
app.add_typer(motor.app, name="motor")
