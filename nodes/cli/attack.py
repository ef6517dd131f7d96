"""The commands ``advnerf attack ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.options import CommandGroup
from nodes.runtime.terminal import Device, Overrides, fail_unless, print_table, table

app = CommandGroup(
    no_args_is_help=True,
    help="Search for textures and poses, look at and examine attacks.",
)

RequestFile = Annotated[
    Path,
    typer.Argument(
        help="A *.experiment.yaml file of one attack in a learned scene of your own.",
        exists=True,
        dir_okay=False,
    ),
]
Output = Annotated[
    Path | None, typer.Option("--output", "-o", help="Folder of the results.", show_default="runs/<name>")
]


@app.command("run")
def attack_run(
    file: RequestFile,
    output: Output = None,
    device: Device = None,
    overrides: Overrides = None,
) -> None:
    """Search as a request asks, for each of its seeds; ends in one attack file per seed. The same command goes on with a stopped search, on the same device to the bit."""
    from advnerf_core.attack.device import use_device
    from nodes.experiment.node.prepare import load_request
    from nodes.experiment.node.printed import print_attacks
    from nodes.experiment.node.search import run_attack
    from nodes.lab.plugin_tables import say_code
    from nodes.runtime.locks import hold_folder
    from nodes.runtime.progress import ProgressDisplay

    use_device(device)
    request = load_request(file, overrides or [], output)
    say_code(request.config.model_dump(mode="json"), file.parent)
    with hold_folder(request.folder), ProgressDisplay() as display:
        files = run_attack(request, request.folder, display)
    print_attacks(files)


@app.command("show")
def attack_show(
    file: Annotated[Path, typer.Argument(help="An attack file.", exists=True, dir_okay=False)],
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder of the pictures and meshes.", show_default="beside FILE"),
    ] = None,
) -> None:
    """Say what an attack file holds; write the face's texture as PNG and found meshes as GLB."""
    from advnerf_core.attack.artifact import load_attack
    from nodes.experiment.node.printed import export_attack, stem_of

    attack = load_attack(file)
    total, clean, face = attack.predicted_total_cte_m, attack.clean_drive, attack.face
    rows = table("what", "value")
    for name, value in {
        "attack id": attack.attack_id,
        "method": attack.method,
        "searched": attack.space.replace("_", " "),
        "seed": attack.seed,
        "predicted total CTE": "unknown" if total is None else f"{total:.2f} m",
        **(
            {}
            if attack.field_total_cte_m is None
            else {"through the field": f"{attack.field_total_cte_m:.2f} m"}
        ),
        "drive without attack": "not driven"
        if clean is None
        else clean.in_words.removeprefix("drive without attack: "),
        **(
            {}
            if clean is None
            else {"of each start": ", ".join(f"{value:.2f} m" for value in clean.total_cte_m)}
        ),
        "face": "none"
        if face is None
        else f"{face.size_m[0]:.3f} x {face.size_m[1]:.3f} m on {face.subject}",
        "camera": f"{attack.camera.width} x {attack.camera.height}",
        "scene": attack.scene_sha256,
        "policy": attack.policy_sha256,
        "config": attack.config_sha256,
        "software": attack.software_version,
        **attack.extra,
        **({"objective": said} if (said := attack.objective_in_words) else {}),
    }.items():
        rows.add_row(name, str(value))
    print_table(rows)
    things = table("object", "searched values", "x [m]", "y [m]", "z of its origin [m]", "yaw [rad]", "scale")
    for each in attack.objects:
        x_m, y_m, yaw_rad, scale = each.placement
        place = (x_m, y_m, float(each.T_world_from_object[2, 3]), yaw_rad, scale)
        things.add_row(
            each.name, " x ".join(map(str, each.theta.shape)), *(f"{value:.3f}" for value in place)
        )
    print_table(things)
    if clean is not None and clean.warning:
        print(clean.warning)
    for path in export_attack(attack, output or file.parent, stem_of(file)):
        print(f"written: {path}")


@app.command("check")
def attack_check(
    file: RequestFile,
    output: Annotated[
        Path | None,
        typer.Option(
            "--output", "-o", help="Folder of check.json and check.png.", show_default="runs/<name>"
        ),
    ] = None,
    directions: Annotated[int, typer.Option(min=2, help="Random directions of each comparison.")] = 8,
    memory: Annotated[bool, typer.Option(help="Also measure peak memory against the horizon.")] = True,
    overrides: Overrides = None,
) -> None:
    """Say whether the gradient can be trusted for this scene, policy and objects; exit code 1 if it cannot."""
    from nodes.experiment.node.check import check, write_check
    from nodes.experiment.node.prepare import load_request
    from nodes.lab.plugin_tables import say_code
    from nodes.runtime.progress import ProgressDisplay

    request = load_request(file, overrides or [], output)
    say_code(request.config.model_dump(mode="json"), file.parent)
    with ProgressDisplay() as display:
        report = display.start("check")
        found = check(request, directions, memory, report)
    for line in found.verdict:
        print(line)
    print(f"written: {', '.join(map(str, write_check(found, request.folder)))}")
    fail_unless(found.sound)


@app.command("maps")
def attack_maps(
    file: RequestFile,
    output: Output = None,
    attack: Annotated[
        Path | None,
        typer.Option(
            "--attack",
            help="An attack file that gives poses and colours; without it, those of the request.",
            exists=True,
            dir_okay=False,
        ),
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Draw the loss landscape and the robustness map (starts x moves of an object) of a request with space.kind places; resumes after a kill."""
    from nodes.experiment.node.poses import mapped
    from nodes.experiment.node.prepare import load_request
    from nodes.runtime.locks import hold_folder
    from nodes.runtime.progress import ProgressDisplay

    request = load_request(file, overrides or [], output)
    folder, maps = request.folder, request.config.maps
    with hold_folder(folder), ProgressDisplay() as display:
        pictures = mapped(request, attack).draw(maps, maps.object, folder, display.start("maps"))
    for picture in pictures:
        print(picture)
