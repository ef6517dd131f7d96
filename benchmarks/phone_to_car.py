"""Does a scene learned from a phone serve the car's camera? The whole way: a phone's video and a driven bag in one model, a scene learned
from the phone's images alone, a colour map fitted on frames of the drive; then what a policy steers on held-out views of the driving
camera, real and rendered.

Needs the run folder of an experiment for its policy and its held-out views, e.g. ``runs/full``. With ``--scene`` another trained
scene in the lab's world is measured instead of the one made here.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.view_loading import load_image
from advnerf_core.policies.network import images_to_tensor
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.scene.colour import IDENTITY
from advnerf_core.scene.field import SceneFieldConfig, save_scene
from advnerf_core.scene.metrics import psnr
from advnerf_core.scene.render_field import FieldRenderer
from advnerf_core.scene.train import TrainConfig, train_scene
from benchmarks.lab_recordings import lab_with_phone, photograph, record_drive, video_poses
from benchmarks.results import record_row
from benchmarks.structure_from_motion import say
from calibration.photo_model import SfmConfig
from hardware.worlds.lab.lab import Lab
from nodes.lab.importing.colours import match_colours
from nodes.lab.importing.data_set import from_phone_and_car
from nodes.lab.importing.driven_bag import BagConfig
from nodes.lab.importing.media import MediaConfig

TARGET_RAD = 0.04
TRAINING_SIZE = (640, 480)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "run", type=Path, help="run folder of an experiment: its policy and held-out views are used"
    )
    parser.add_argument("--scene", type=Path, help="measure this scene file instead of making one")
    parser.add_argument(
        "--folder", type=Path, default=Path("runs/phone_to_car"), help="working folder; goes on there"
    )
    parser.add_argument("--frames", type=int, default=150, help="frames of the phone's video")
    parser.add_argument("--steps", type=int, default=700, help="training iterations of the scene")
    parser.add_argument("--trial", action="store_true", help="print, but do not write the ledger")
    arguments = parser.parse_args()

    facts = ""
    scene = arguments.scene
    if scene is None:
        scene, facts = make_scene(arguments.folder, arguments.frames, arguments.steps)
    with_map, without = (
        compare(arguments.run, scene, mapped=True),
        compare(arguments.run, scene, mapped=False),
    )
    note = (
        f"{with_map['views']} held-out views; without the map {without['steering_rad']:.4f} rad; PSNR at 200x66 {with_map['psnr_db']:.1f} dB, "
        f"without {without['psnr_db']:.1f} dB{facts}"
    )
    print(f"{with_map['steering_rad']:.4f} rad: {note}")
    if not arguments.trial and arguments.scene is None:
        record_row(
            "surrogate from the phone camera, seen by the car's camera, steering",
            with_map["steering_rad"],
            "rad mean abs",
            "<= 0.04 rad",
            with_map["steering_rad"] <= TARGET_RAD,
            f"python -m benchmarks.phone_to_car {arguments.run}",
            note,
        )


def make_scene(folder: Path, frames: int, steps: int) -> tuple[Path, str]:
    """Record, put together, learn, match colours; what is there already is used again."""
    phone, bag, data = folder / "phone", folder / "drive", folder / "data"
    config = lab_with_phone(960)
    with Lab(config) as lab:
        if not phone.exists():
            photograph(lab, video_poses(config, frames), phone)
        if not (bag / "metadata.yaml").exists():
            record_drive(lab, bag)
    report = from_phone_and_car(
        [phone],
        bag,
        data,
        MediaConfig(),
        BagConfig(0.15, math.radians(8.0)),
        SfmConfig(),
        0.08,
        say,
    )
    placing, model = report["placing"], report["structure_from_motion"]
    listed = load_transforms(data / "transforms_phone.json")
    low, high = ((float(x), float(y), float(z)) for x, y, z in listed.box())
    trained = train_scene(
        listed.load(TRAINING_SIZE),
        SceneFieldConfig(low, high),
        TrainConfig(steps=steps, seed=0),
        folder / "checkpoint.safetensors",
        lambda at: say(at.fraction, f"step {at.step}, {at.psnr_db:.1f} dB on training rays"),
    )
    scene = folder / "scene.safetensors"
    save_scene(scene, trained.scene, trained.occupied, {"march": vars(trained.march), "steps": steps})
    match_colours(scene, data / "transforms_car.json", scene, 12)
    total = model["registered"] + len(model["left_out"])
    return scene, (
        f"; {model['registered']} of {total} images of phone and car in one model, placed in the motion-capture world with "
        f"{1000 * placing['rms_position_m']:.1f} mm and {math.degrees(placing['rms_rotation_rad']):.2f} degrees rms"
    )


def compare(run: Path, scene: Path, mapped: bool) -> dict[str, Any]:
    """Mean absolute difference of steering between real and rendered held-out views, and their PSNR as the policy sees them."""
    loaded = load_policy(run / "policy" / "policy.safetensors")
    renderer = FieldRenderer.from_file(scene, None if mapped else IDENTITY)
    differences, psnrs = [], []
    for frame in load_transforms(run / "capture" / "held_out", require_all=True).frames:
        real = loaded.view.image(load_image(frame)[0])
        rendered = renderer.render(frame.T_world_from_camera[None], loaded.view.pinhole)[0]
        with torch.no_grad():
            on_real = float(loaded.policy(images_to_tensor(real))[0])
            on_rendered = float(loaded.policy(rendered.permute(0, 3, 1, 2))[0])
        differences.append(abs(on_real - on_rendered))
        psnrs.append(psnr(rendered[0].numpy(), real / 255.0))
    return {
        "views": len(differences),
        "steering_rad": float(np.mean(differences)),
        "psnr_db": float(np.mean(psnrs)),
    }


if __name__ == "__main__":
    main()
