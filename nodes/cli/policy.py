"""The commands ``advnerf policy ...``."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from advnerf_core.unit_bounds import MOST_SPEED_MPS
from nodes.cli import policy_train as cli_policy_train
from nodes.cli.policy_train import Goal
from nodes.runtime.findings import CheckFinding
from nodes.runtime.options import CommandGroup
from nodes.runtime.paths import shipped
from nodes.runtime.terminal import FAILURE_EXIT, PolicyName, fail_unless, print_findings, print_table, table
from nodes.runtime.termination import ends_in_order

if TYPE_CHECKING:
    from advnerf_core.policies.view import PolicyView
    from nodes.lab.policy_reference import ReferenceFrames

ServiceMode = Literal["carla", "alpasim"]
_TWIN_ROOM = shipped("calibration/twin/room.yaml")

app = CommandGroup(
    no_args_is_help=True,
    help="Train a policy from recordings; evaluate, check, export and inspect any policy.",
)
app.command("train")(cli_policy_train.train)
app.command("eval")(cli_policy_train.evaluate)


@app.command("check")
def policy_check(
    policy: PolicyName,
    run_folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            exists=True,
            help="Run folder of an experiment: check on the camera frames of its capture and on drives in its learned scene.",
        ),
    ] = None,
    scene: Annotated[
        Path | None,
        typer.Option(
            exists=True, help="Learned scene: check on its views and on drives in it. Needs --calibration."
        ),
    ] = None,
    calibration: Annotated[
        Path | None,
        typer.Option(
            exists=True,
            dir_okay=False,
            help="camera.yaml of the scene, with room.yaml and vehicle.yaml beside it.",
        ),
    ] = None,
    bag: Annotated[
        Path | None, typer.Option(exists=True, help="Bag of a drive: check on its frames and poses.")
    ] = None,
    picture: Annotated[
        Path | None,
        typer.Option(
            exists=True, help="Picture of the policy's camera: check the adapter on it, without an expert."
        ),
    ] = None,
    room: Annotated[
        Path,
        typer.Option(
            exists=True,
            help="Room calibration with the path that the expert follows in the bag.",
            show_default="the simulated lab's",
        ),
    ] = _TWIN_ROOM,
    goal: Goal = None,
) -> None:
    """Check a policy's adapter and whether the policy drives. Without a source option, the simulated lab is used.

    Of a file without a declaration it prints one to correct. Exit code 1 then, if the adapter is wrong, or if the policy does not drive in the
    given scene.
    """
    from advnerf_core.attack.methods import black_box_methods
    from advnerf_core.policies.conformance import check_policy
    from advnerf_core.policies.load import is_factory, load_adapted
    from nodes.lab.policy_reference import judged_by_drives

    if not is_factory(policy) and _lacks_declaration(Path(policy)):
        raise typer.Exit(FAILURE_EXIT)
    adapted, sha256 = load_adapted(policy)
    reference = _reference(adapted.contract.view, run_folder, bag, room, scene, calibration, picture)
    print(f"{policy} ({sha256[:12]}) on {reference.source}")
    told = tuple(goal) if goal else None
    methods = black_box_methods(adapted.stateless)
    findings = check_policy(adapted, reference.images, reference.steering_rad, told, methods)
    findings = judged_by_drives(adapted, reference, findings, told)
    rows = [CheckFinding(each.name, each.verdict, each.text) for each in findings]
    fail_unless(print_findings(rows, "check"))


def _lacks_declaration(file: Path) -> bool:
    """Whether a file does not say how it was trained; then print what it says, and a declaration to correct."""
    from advnerf_core.policies.declaration import DECLARATION_SUFFIX
    from advnerf_core.policies.guess import declaration_text, guess_contract, tensors_of

    contract, questions = guess_contract(file)
    if not questions:
        return False
    inputs, outputs, _ = tensors_of(file)
    print(f"{file} takes {', '.join(map(str, inputs))} and gives {', '.join(map(str, outputs))}.")
    print("It does not say how it was trained. Correct what the comments ask for, and save these lines as")
    print(f"{file}{DECLARATION_SUFFIX}:\n\n{declaration_text(contract, questions)}")
    return True


def _reference(
    view: PolicyView,
    run_folder: Path | None,
    bag: Path | None,
    room: Path,
    scene: Path | None,
    calibration: Path | None,
    picture: Path | None,
) -> ReferenceFrames:
    from nodes.lab.policy_reference import from_bag, from_picture, from_run, from_scene, from_twin
    from nodes.runtime.errors import ConfigError

    if sum(each is not None for each in (run_folder, bag, scene, picture)) > 1:
        raise ConfigError(
            "expected at most one of --folder, --bag, --scene and --picture, got several; keep one"
        )
    if picture is not None:
        return from_picture(picture, view)
    if (scene is None) != (calibration is None):
        raise ConfigError("expected --scene and --calibration together, got one of them; add the other")
    if scene is not None and calibration is not None:
        return from_scene(scene, calibration.parent, view)
    if run_folder is not None:
        return from_run(run_folder, view)
    return from_bag(bag, room, view) if bag is not None else from_twin(view)


@app.command("serve")
def policy_serve(
    policy: PolicyName,
    listen: Annotated[
        str,
        typer.Option(
            metavar="HOST:PORT",
            help="Where to listen. An address that other computers reach is served by TLS with your certificate.",
        ),
    ] = "127.0.0.1:6789",
    wheelbase_m: Annotated[
        float | None,
        typer.Option(
            "--wheelbase",
            min=0.0,
            help="Wheelbase that makes an arc of a wheel angle [m]; not needed for waypoints.",
        ),
    ] = None,
    speed_mps: Annotated[
        float | None,
        typer.Option(
            "--speed",
            min=0.0,
            max=MOST_SPEED_MPS,
            help="Speed of the plans [m/s].",
            show_default="the car's own; not used with waypoints",
        ),
    ] = None,
    goal: Goal = None,
    runtime: Annotated[
        ServiceMode, typer.Option(help="What asks: CARLA's and Autoware's tools, or alpasim itself.")
    ] = "carla",
) -> None:
    """Offer a policy to others as a driver behind gRPC, in the egodriver protocol of alpasim, Autoware and CARLA users, until Ctrl-C."""
    from advnerf_core.policies.load import load_driver
    from nodes.lab.policy_server import ServedCar, ServedPolicy, serving
    from nodes.operator_page.certificate import certificate

    name = policy.rpartition("/")[2]
    served = ServedPolicy(load_driver(policy), name, ServedCar(wheelbase_m, speed_mps, tuple(goal or ())))
    with ends_in_order(), serving(served, listen, runtime) as address:
        print(f"{served.name} serves on {address}; Ctrl-C ends it", flush=True)
        if address.startswith("grpcs"):
            print(
                f"Others need its certificate, {certificate().file}; ours takes it as GRPC_DEFAULT_SSL_ROOTS_FILE_PATH",
                flush=True,
            )
        threading.Event().wait()


@app.command("export")
def policy_export(
    policy: PolicyName,
    onnx: Annotated[Path | None, typer.Option(help="Write an ONNX file, which runs without torch.")] = None,
    pt2: Annotated[
        Path | None, typer.Option(help="Write a torch.export program, which keeps the gradient.")
    ] = None,
) -> None:
    """Export a policy and its declaration to a file that does not need the policy's source code."""
    from advnerf_core.files import refuse_overwriting
    from advnerf_core.policies.load import is_code, load_adapted, load_any_policy
    from nodes.runtime.errors import ConfigError

    if onnx is None and pt2 is None:
        raise ConfigError("expected --onnx FILE or --pt2 FILE, got neither; give at least one")
    for option, file in (("onnx", onnx), ("pt2", pt2)):
        if file is not None and file.suffix != f".{option}":  # which a policy is recognised by
            raise ConfigError(
                f"--{option}: expected a file name that ends with .{option}, got {file}; correct it"
            )
    if not is_code(policy) and Path(policy).suffix == ".onnx":
        raise ConfigError(
            f"expected a policy with its network in torch, got {policy}, which cannot be converted; "
            "name the policy that it was exported from"
        )
    given = None if is_code(policy) else Path(policy)
    refuse_overwriting([given], [each for each in (onnx, pt2) if each is not None])
    load_any_policy(policy)  # rejects a policy that nodes could not load
    adapted, _ = load_adapted(policy)
    adapted.requires_grad_(False)
    if onnx is not None:
        from advnerf_core.policies.onnx_policy import OnnxNetwork, export_onnx

        export_onnx(adapted.network, adapted.contract, onnx)
        print(f"{onnx} {OnnxNetwork(onnx).sha256[:12]}")
    if pt2 is not None:
        from advnerf_core.policies.exported_policy import export_program, load_program

        export_program(adapted.network, adapted.contract, pt2)
        print(f"{pt2} {load_program(pt2)[2][:12]}")


@app.command("info")
def policy_info(policy: PolicyName) -> None:
    """Show a policy's inputs and outputs, its declaration, its architecture and its hash."""
    from advnerf_core.policies.load import described_policy

    adapted, sha256, network = described_policy(policy)
    contract = adapted.contract
    rows = table("what", "value")
    for name, value in adapted.described_tensors():
        rows.add_row(name, value)
    for name, value in network.items():
        rows.add_row(name, value)
    for name, value in contract.to_dict().items():
        if name != "view":
            rows.add_row(name, str(value))
    view = contract.view
    rows.add_row("image", f"{view.width} x {view.height}")
    kept_rows, kept_columns = view.window
    crop = f"rows {kept_rows.start} to {kept_rows.stop - 1}, columns {kept_columns.start} to {kept_columns.stop - 1}"
    rows.add_row("view", f"{crop} of {view.camera.width} x {view.camera.height}")
    rows.add_row("sha256", sha256)
    if adapted.identity:
        rows.add_row("not fixed", f"asks another program, which may change: {adapted.identity}")
    print_table(rows)
