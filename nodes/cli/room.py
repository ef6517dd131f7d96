"""The commands ``advnerf scene room ...``: reference path, fence, targets, and the placement of board and monitor."""

from __future__ import annotations

from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import FAILURE_EXIT, RunDir, numbers_of, print_table, say_error, table

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from advnerf_core.geometry import Array
    from calibration.path_fit import PathFit
    from calibration.schema import RoomCalibration

app = CommandGroup(
    no_args_is_help=True, help="Measure path, fence and targets with motion capture; place board and monitor."
)

BagFile = Annotated[Path, typer.Argument(help="Bag with the trace.", exists=True)]
Topic = Annotated[str, typer.Option("--topic", help="Topic of the trace: /vicon/car or /vicon/wand.")]
Output = Annotated[Path, typer.Option("--output", "-o", help="YAML file to write.")]
_ORIGIN = "0,0,0"
_OFF_TRACK_M, _FENCE_MARGIN_M = 0.4, 0.8


@app.command("path")
def room_path(
    bag: BagFile,
    output: Output = Path("room.yaml"),
    topic: Topic = "/vicon/car",
    closed: Annotated[
        bool | None, typer.Option("--closed/--open", help="A loop or not.", show_default="looks")
    ] = None,
    corner: Annotated[int, typer.Option(help="Corner of the attack: number of the arc, from 1.")] = 1,
    before_m: Annotated[
        float, typer.Option("--before", help="Distance of the start pose before that corner [m].")
    ] = 2.0,
    off_track_m: Annotated[
        float | None,
        typer.Option(
            "--off-track",
            help="Absolute CTE beyond which the car is off track [m].",
            show_default="of an existing file, else 0.4",
        ),
    ] = None,
    fence_margin_m: Annotated[
        float | None,
        typer.Option(
            "--fence-margin",
            help="Distance of a provisional fence from the path [m]; it replaces the fence of an existing file.",
            show_default="the fence of an existing file, else 0.8",
        ),
    ] = None,
) -> None:
    """Fit the reference path to a trace of the car or the wand. The fence of an existing file is kept."""
    from calibration.path_fit import fit_path
    from calibration.plots import save_with_plot
    from calibration.room import clearance, fence_around, start_before_corner
    from calibration.schema import RoomCalibration, measured

    trace = _way(bag, topic)
    fit = fit_path(trace, closed)
    old = _old_room(output)
    if old is not None and fence_margin_m is None:
        fence, provisional = old.fence_m, False
    else:
        margin_m = _FENCE_MARGIN_M if fence_margin_m is None else fence_margin_m
        fence, provisional = fence_around(fit.path, margin_m), True
    if off_track_m is None:
        off_track_m = old.off_track_m if old else _OFF_TRACK_M
    _require_clearance(clearance(fit.path, fence))
    room = measured(
        RoomCalibration,
        date=date.today(),
        method=f"path fitted to {topic}",
        path=fit.path.to_dict(),
        off_track_m=off_track_m,
        fence_m=fence,
        start_pose=start_before_corner(fit.path, corner, before_m),
        residuals={"path_rms_mm": round(1e3 * fit.rms_m, 2), "path_worst_mm": round(1e3 * fit.worst_m, 2)},
        views=len(fit.trace),
    )
    picture = save_with_plot(room, output, lambda figure: _draw(figure, room, fit.trace, fit))
    _print_fit(fit)
    print(f"start {before_m:g} m before corner {corner}: {room.start_pose}")
    print(
        f"{output} and {picture}"
        + ("; the fence is provisional, measure it with advnerf scene room fence" if provisional else "")
    )


@app.command("fence")
def room_fence(
    bag: BagFile,
    output: Output = Path("room.yaml"),
    topic: Topic = "/vicon/wand",
    margin_m: Annotated[
        float, typer.Option("--margin", min=0.0, help="Distance of the fence inside the walked outline [m].")
    ] = 0.3,
) -> None:
    """Fit the fence to a walk around the free floor with the car or a wand. Run ``advnerf scene room path`` first."""
    from calibration.plots import save_with_plot
    from calibration.room import clearance, fence_from_trace
    from calibration.schema import CalibrationError, RoomCalibration, measured
    from nodes.lab.wizards.bags import read_poses

    old = _old_room(output)
    if old is None:
        raise CalibrationError(
            f"expected a room file at {output}, found none; fit the path first with advnerf scene room path"
        )
    trace = read_poses(bag, topic).T[:, :2, 3]
    fence = fence_from_trace(trace, margin_m)
    least_m = clearance(old.reference_path, fence)
    _require_clearance(least_m)
    room = measured(
        RoomCalibration,
        date=date.today(),
        method=f"{old.method}; fence walked with {topic}",
        path=old.path,
        off_track_m=old.off_track_m,
        fence_m=fence,
        start_pose=old.start_pose,
        residuals=old.residuals,
        views=old.views,
    )
    picture = save_with_plot(room, output, lambda figure: _draw(figure, room, trace))
    print(f"fence of {len(fence)} corners, at least {least_m:.2f} m from the path; {output} and {picture}")


@app.command("target")
def room_target(
    output: Annotated[Path, typer.Option("--output", "-o", help="YAML file to write.")],
    subject: Annotated[str, typer.Option(help="Motion-capture subject: board or monitor.")],
    bag: Annotated[
        Path | None, typer.Argument(help="Bag in which a wand touches the corners.", exists=True)
    ] = None,
    size: Annotated[
        str | None,
        typer.Option("--face-size", metavar="WxH", help="Width x height instead of a bag [m]."),
    ] = None,
    centre: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="Centre of the face in the subject's frame [m].")
    ] = _ORIGIN,
    yaw_deg: Annotated[
        float, typer.Option("--yaw", help="Direction of the face, about the subject's z axis [deg].")
    ] = 0.0,
    wand: Annotated[str, typer.Option(help="Topic of the wand.")] = "/vicon/wand",
    tip: Annotated[
        str, typer.Option(metavar="X,Y,Z", help="Tip of the wand in the wand's frame [m].")
    ] = _ORIGIN,
) -> None:
    """Measure the pose of a face in its subject's frame, with a ruler or by touching its corners with a wand.

    Hold the wand for a second at the top left, top right, bottom right and bottom left corner, seen from the front.
    For a monitor, measure the whole panel. The attack uses its centre square, whose size is printed.
    """
    import numpy as np

    from advnerf_core.files import refuse_overwriting
    from calibration.panel import target_size
    from calibration.room import target_of_size, target_of_touches
    from calibration.schema import CalibrationError, save_calibration

    if (bag is None) == (size is None):
        raise CalibrationError(
            "expected either a bag in which a wand touches the corners or --face-size WxH; give one of them"
        )
    unused = {"--centre": centre, "--yaw": yaw_deg} if size is None else {"--tip": tip}
    if ignored := [name for name, value in unused.items() if value not in (_ORIGIN, 0.0)]:
        raise CalibrationError(
            f"expected --centre and --yaw with --face-size, and --tip with a bag, got {' and '.join(ignored)} with the other; leave it out"
        )
    refuse_overwriting([bag], [output])
    if size is not None:
        width, height = numbers_of("--face-size", size.replace("x", ","), 2, "in metres", "0.598x0.336")
        target = target_of_size(
            subject,
            (width, height),
            _point(centre, "--centre"),
            float(np.deg2rad(yaw_deg)),
            "measured with a ruler",
        )
    else:
        assert bag is not None
        target = target_of_touches(subject, _touches(bag, wand, f"/vicon/{subject}", _point(tip, "--tip")))
    save_calibration(target, output)
    width, height = target_size(target)
    print(f"{output}: {subject}, {width:.4f} x {height:.4f} m, {target.residuals or 'nothing fitted'}")
    print(f"an attack on it may be {min(width, height):.4f} m wide: size_m: {min(width, height):.4f}")


@app.command("place")
def room_place(
    attack_file: Annotated[Path, typer.Argument(help="Attack file.", exists=True, dir_okay=False)],
    target_file: Annotated[
        Path,
        typer.Option(
            "--target", help="Target file of the board or monitor that shows the attack.", exists=True
        ),
    ],
    request: Annotated[
        Path | None,
        typer.Option(
            help="The attack's *.experiment.yaml. A copy for the measured pose is written.", exists=True
        ),
    ] = None,
    tolerance_cm: Annotated[
        float, typer.Option(min=0.1, help="Largest accepted distance from the pose [cm].")
    ] = 2.0,
    tolerance_deg: Annotated[
        float, typer.Option(min=0.1, help="Largest accepted rotation from the pose [deg].")
    ] = 2.0,
    once: Annotated[
        bool, typer.Option("--once", help="Measure once. Exit code 1 if the target is out of place.")
    ] = False,
    timeout_s: Annotated[
        float, typer.Option("--timeout", min=1.0, help="Give up after this time [s].")
    ] = 600.0,
    run_dir: RunDir = None,
) -> None:
    """Guide the board or monitor to the pose for which its attack was computed, live. Exit code 1 if it is off."""
    import numpy as np

    from advnerf_core.attack.artifact import load_attack
    from calibration.panel import make_panel, require_fits
    from calibration.schema import TargetCalibration, load_calibration
    from nodes.lab.room.placing import guide, in_short, say_how_to_attack_again
    from nodes.launching.watching import find_run_dir

    attack, target = load_attack(attack_file), load_calibration(TargetCalibration, target_file)
    require_fits(attack, make_panel((1000, 1000), target), target)
    limits = tolerance_cm / 100.0, float(np.deg2rad(tolerance_deg))
    found = guide(find_run_dir(run_dir), attack, target, limits, once, timeout_s)
    if found is None:
        say_error(
            f"expected a pose of {target.subject} within {timeout_s:g} s, got none; is it in view of motion capture?"
        )
        raise typer.Exit(FAILURE_EXIT)
    off, T_world_from_subject = found
    if off.within(*limits):
        print(f"{target.subject} is in place for attack {attack.attack_id}: {in_short(off)}")
        return
    say_error(
        f"{target.subject} is {in_short(off)} from the pose of attack {attack.attack_id}: move it, or compute the attack again"
    )
    say_how_to_attack_again(request, target, T_world_from_subject)
    raise typer.Exit(FAILURE_EXIT)


def _way(bag: Path, topic: str) -> Array:
    """A trace whose direction is the path's; that of the car is checked by its heading, and where it was carried is left out."""
    import numpy as np

    from calibration.path_fit import driven_part, require_forward
    from nodes.lab.wizards.bags import CAR, read_poses

    T = read_poses(bag, topic).T
    if topic == CAR:
        recorded = len(T)
        T = T[driven_part(T[:, :3, 3])]
        if len(T) < recorded:
            print(
                f"{recorded - len(T)} of {recorded} poses are left out: the car was carried, or lifted, then"
            )
        require_forward(T[:, :2, 3], np.arctan2(T[:, 1, 0], T[:, 0, 0]))
    return T[:, :2, 3]


def _touches(bag: Path, wand: str, subject: str, tip: tuple[float, float, float]) -> Any:
    import numpy as np

    from calibration.room import find_touches
    from nodes.lab.wizards.bags import read_poses

    drawn, carried = read_poses(bag, wand), read_poses(bag, subject)
    # The target stands still while its corners are touched, so its nearest pose is exact.
    nearest = np.clip(np.searchsorted(carried.stamps_ns, drawn.stamps_ns), 0, len(carried.stamps_ns) - 1)
    return find_touches(drawn.stamps_ns, drawn.T, carried.T[nearest], tip)


def _old_room(file: Path) -> RoomCalibration | None:
    from calibration.schema import RoomCalibration, load_calibration

    return load_calibration(RoomCalibration, file) if file.exists() else None


def _require_clearance(least_m: float) -> None:
    from calibration.degeneracy import DegenerateDataError

    if least_m <= 0.0:
        raise DegenerateDataError(
            f"expected the path inside the fence; it is {-least_m:.2f} m outside. Walk around the whole path"
        )


def _print_fit(fit: PathFit) -> None:
    from advnerf_core.driving.path import Line

    rows = table("piece", "length [m]", "radius [m]", "turn [deg]")
    for piece in fit.path.segments:
        if isinstance(piece, Line):
            rows.add_row("line", f"{piece.length_m:.3f}", "", "")
        else:
            rows.add_row(
                "arc", f"{piece.length_m:.3f}", f"{piece.radius_m:.3f}", f"{57.29578 * piece.angle_rad:+.1f}"
            )
    print_table(rows)
    kind = (
        f"closed, {fit.path.length_m:.2f} m, {fit.laps:.1f} laps"
        if fit.path.closed
        else f"open, {fit.path.length_m:.2f} m"
    )
    print(f"{kind}; residuals {1e3 * fit.rms_m:.1f} mm rms, {1e3 * fit.worst_m:.1f} mm at worst")


def _draw(figure: Figure, room: RoomCalibration, trace: Array, fit: PathFit | None = None) -> None:
    import numpy as np

    axes = figure.subplots(1, 2 if fit else 1, squeeze=False)[0]
    path = room.reference_path
    drawn = path.pose_at(np.linspace(0.0, path.length_m, 1000))
    fence = np.array([*room.fence_m, room.fence_m[0]])
    axes[0].plot(trace[:, 0], trace[:, 1], ".", markersize=2, color="tab:gray", label="trace")
    axes[0].plot(drawn[:, 0], drawn[:, 1], color="tab:green", label="path")
    axes[0].plot(fence[:, 0], fence[:, 1], "--", color="tab:red", label="fence")
    axes[0].plot(*room.start_pose[:2], "k>", label="start")
    axes[0].set(aspect="equal", xlabel="x [m]", ylabel="y [m]")
    axes[0].legend(fontsize="small")
    if fit:
        axes[1].plot(path.project(fit.trace).s_m, 1e3 * fit.residuals_m, ".", markersize=2)
        axes[1].set(
            xlabel="along the path [m]", ylabel="distance from it [mm]", title=f"rms {1e3 * fit.rms_m:.1f} mm"
        )


def _point(text: str, option: str) -> tuple[float, float, float]:
    x, y, z = numbers_of(option, text, 3, "in metres", "0,0,0.1")
    return x, y, z
