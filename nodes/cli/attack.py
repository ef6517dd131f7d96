"""The commands ``advnerf attack ...``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from nodes.runtime.terminal import Overrides, print_table, table

app = typer.Typer(
    no_args_is_help=True, help="Search for textures and poses, go on with a search, look at and examine attacks."
)

RequestFile = Annotated[Path, typer.Argument(help="A *.attack.yaml file.", exists=True, dir_okay=False)]


@app.command("run")
def attack_run(
    file: RequestFile,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Folder of the results.", show_default="runs/<name>")
    ] = None,
    overrides: Overrides = None,
) -> None:
    """Search as a request asks, for each of its seeds; ends in one attack file per seed."""
    from nodes.experiment.request.request import load_request

    request = load_request(file, overrides or [])
    _run(output or Path("runs") / request.name, request)


@app.command("resume")
def attack_resume(folder: Annotated[Path, typer.Argument(help="Folder of 'advnerf attack run'.", exists=True)]) -> None:
    """Go on with a search that was stopped or killed; on a CPU to the bit."""
    from nodes.experiment.request.search import kept_request

    _run(folder, kept_request(folder))


def _run(folder: Path, request: object) -> None:
    from nodes.experiment.request.printed import print_attacks
    from nodes.experiment.request.request import AttackRequest
    from nodes.experiment.request.search import run_attack
    from nodes.runtime.errors import ConfigError
    from nodes.runtime.locks import HeldError, hold
    from nodes.runtime.progress import ProgressDisplay

    assert isinstance(request, AttackRequest)
    folder.mkdir(parents=True, exist_ok=True)
    try:
        lock = hold(folder / ".lock")
    except HeldError as error:
        raise ConfigError(f"{folder} is in use by process {error.owner}: wait for it, or stop it") from None
    with lock, ProgressDisplay() as display:
        files = run_attack(request, folder, display)
    print_attacks(files)


@app.command("show")
def attack_show(
    file: Annotated[Path, typer.Argument(help="An attack file.", dir_okay=False)],
    texture: Annotated[
        Path | None,
        typer.Option("--texture", help="Write the displayed texture here (PNG).", show_default="beside FILE"),
    ] = None,
) -> None:
    """Say what an attack file holds, and write its texture as an image."""
    import cv2

    from advnerf_core.attack.artifact import load_attack
    from advnerf_core.files import write_atomically

    attack = load_attack(file)
    total, clean = attack.predicted_total_cte_m, attack.clean_drive
    rows = table("what", "value")
    for name, value in {
        "attack id": attack.attack_id, "method": attack.method, "seed": attack.seed,
        "predicted total CTE": "unknown" if total is None else f"{total:.2f} m",
        "drive without attack": "not driven" if clean is None else clean.in_words.removeprefix("drive without attack: "),
        **({} if clean is None else {"of each start": ", ".join(f"{value:.2f} m" for value in clean.total_cte_m)}),
        "face": f"{attack.size_m[0]:.3f} x {attack.size_m[1]:.3f} m on {attack.subject}" if attack.has_face else "none",
        "theta": " x ".join(map(str, attack.theta.shape)),
        "position": ", ".join(f"{v:.3f}" for v in attack.T_world_from_object[:3, 3]) + " m",
        "camera": f"{attack.camera.width} x {attack.camera.height}", "scene": attack.scene_sha256,
        "policy": attack.policy_sha256, "config": attack.config_sha256, "software": attack.software_version,
        **{f"object {k}": f"{o.name}, {o.theta.size} values" for k, o in enumerate(attack.objects)},
        **{key: str(value) for key, value in attack.extra.items()},
    }.items():  # fmt: skip
        rows.add_row(name, str(value))
    print_table(rows)
    if clean is not None and clean.warning:
        print(clean.warning)
    if attack.has_face:
        path = texture or file.with_name(
            file.name.removesuffix(".safetensors").removesuffix(".attack") + ".texture.png"
        )
        write_atomically(path, cv2.imencode(".png", attack.texture[..., ::-1])[1].tobytes())
        print(f"texture: {path}")


@app.command("check")
def attack_check(
    file: RequestFile,
    output: Annotated[
        Path | None,
        typer.Option("--output", "-o", help="Folder of check.json and check.png.", show_default="runs/<name>"),
    ] = None,
    directions: Annotated[int, typer.Option("--directions", min=2, help="Random directions of each comparison.")] = 8,
    memory: Annotated[bool, typer.Option(help="Also measure peak memory against the horizon.")] = True,
    overrides: Overrides = None,
) -> None:
    """Say whether the gradient can be trusted for this scene, policy and objects; exit code 1 if it cannot."""
    from nodes.experiment.request.check import check, write_check
    from nodes.experiment.request.request import load_request
    from nodes.runtime.progress import ProgressDisplay

    request = load_request(file, overrides or [])
    folder = output or Path("runs") / request.name
    with ProgressDisplay() as display:
        report = display.start("check")
        found = check(request, directions, memory, report)
    for line in found.verdict:
        print(line)
    print(f"written: {', '.join(map(str, write_check(found, folder)))}")
    if not found.sound:
        raise typer.Exit(1)
