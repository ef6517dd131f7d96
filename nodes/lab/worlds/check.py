"""Checks that a world keeps its contract: one line for each part of it, met or not, and why."""

from __future__ import annotations

import json
from collections.abc import Collection
from pathlib import Path

import cv2
import numpy as np

from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.geometry import planar_pose
from advnerf_core.plugins import unknown
from hardware.worlds.world import (
    NativeMeshes,
    NativePanels,
    NotOpenError,
    World,
    WorldDescription,
    require_depth,
    traits_of,
)
from nodes.lab.worlds.bench import Check, WorldBench
from nodes.lab.worlds.driving import (
    expert_keeps_its_lane,
    is_put_down,
    moves_as_described,
    paths_are_drivable,
)
from nodes.lab.worlds.geometry import box_holds_what_is_seen, ground_is_flat, photographs_cover, views_agree
from nodes.lab.worlds.named import NamedWorld
from nodes.lab.worlds.panels import meshes_are_native, panels_are_native
from nodes.lab.worlds.pictures import form, is_not_late, photographs_match, repeats, takes_no_time
from nodes.runtime.errors import ConfigError
from nodes.runtime.findings import CheckFinding, NotMet, look

_DESCRIPTION = "description"
# Without it the others cannot run.
_FIRST = "pictures"
_CHECKS: tuple[tuple[str, Check], ...] = (
    ("repeatable", repeats),
    ("time", takes_no_time),
    ("reset", is_put_down),
    ("car", moves_as_described),
    ("frames", is_not_late),
    ("camera", views_agree),
    ("ground", ground_is_flat),
    ("photographs", photographs_match),
    ("coverage", photographs_cover),
    ("box", box_holds_what_is_seen),
    ("paths", paths_are_drivable),
    ("expert", expert_keeps_its_lane),
)
# Errors that a world raises itself, such as that its server is gone.
_OF_THE_WORLD = (AdvnerfError,)
# For worlds that take panels, or meshes, into their own scene.
_NATIVE: tuple[tuple[type, tuple[str, Check]], ...] = (
    (NativePanels, ("panels", panels_are_native)),
    (NativeMeshes, ("meshes", meshes_are_native)),
)


def check_world(
    named: NamedWorld, pictures: Path | None = None, only: Collection[str] = ()
) -> list[CheckFinding]:
    """Run all checks of a world from the outside.

    Args:
        pictures: Folder for a picture of the driving camera and a photograph, for a person to inspect.
        only: Parts of the contract to check, beside the first ones; all of them if empty.

    Returns:
        A line for each part of the contract; fewer if a first check fails without which the others cannot run.

    Raises:
        AdvnerfError: The world cannot be made or opened; its own message.
        ConfigError: No part has this name.
    """
    names = (_DESCRIPTION, _FIRST, *(name for name, _ in (*_CHECKS, *(each for _, each in _NATIVE))))
    for name in only:
        if name not in names:
            raise ConfigError(unknown(name, "part of the contract", names))
    closed = _described(named.make())
    findings: list[CheckFinding] = []
    with named.make() as world:
        described = world.describe()
        findings.append(
            look(
                _DESCRIPTION,
                lambda bench: _is_consistent(bench, closed),
                WorldBench(named, world, described, None),
                _OF_THE_WORLD,
            )
        )
        bench = WorldBench(named, world, described, traits_of(world).step_s)
        findings.append(look(_FIRST, form, bench, _OF_THE_WORLD))
        if not findings[-1].met:
            return findings
        if pictures is not None:
            _write_pictures(bench, pictures)
        wanted = (*_CHECKS, *(each for kind, each in _NATIVE if isinstance(world, kind)))
        findings += [
            look(name, check, bench, _OF_THE_WORLD) for name, check in wanted if not only or name in only
        ]
    return findings


def _described(world: World) -> WorldDescription | None:
    """A world's description before it is opened; None if it must be open for that."""
    try:
        return world.describe()
    except NotOpenError:
        return None


def _is_consistent(bench: WorldBench, closed: WorldDescription | None) -> str:
    """The description is the same every time and through JSON, and has the world's camera; settings are JSON."""
    world, described = bench.world, bench.description
    text = json.dumps(described.to_dict())
    for when, other in (("when it is asked again", world.describe()), ("before it is opened", closed)):
        if other is not None and json.dumps(other.to_dict()) != text:
            raise NotMet(
                f"expected the same description every time; got another one {when}; raise NotOpenError where the world must be asked first"
            )
    if WorldDescription.from_dict(json.loads(text)).to_dict() != json.loads(text):
        raise NotMet("expected a description that JSON keeps; facts must be plain data with text as keys")
    if described.camera != world.camera_pinhole:
        raise NotMet(f"expected camera to be camera_pinhole, {world.camera_pinhole}; got {described.camera}")
    if not np.allclose(described.T_car_from_camera, world.T_car_from_camera, atol=1e-9):
        raise NotMet("expected T_car_from_camera to be the same in the world and in its description; got two")
    settings = bench.named.settings
    json.dumps(settings)
    unknown = [key for key in traits_of(world).unseen if not _has(settings, key)]
    if unknown:
        raise NotMet(f"expected traits.unseen to name keys of the configuration; got {', '.join(unknown)}")
    paths = ", ".join(f"{name} ({path.length_m:.1f} m)" for name, path in described.paths.items())
    return f"{described.car.kind} car, {described.car.speed_mps:g} m/s, lanes of {2.0 * described.off_track_m:g} m; paths {paths}"


def _has(settings: dict[str, object], key: str) -> bool:
    found: object = settings
    for step in key.split("."):
        if not isinstance(found, dict) or step not in found:
            return False
        found = found[step]
    return True


def _write_pictures(bench: WorldBench, folder: Path) -> None:
    """Write the driving camera's picture at the start of each path, its depth (near is bright), and a photograph from there."""
    for name, path in bench.description.paths.items():
        rgb, depth = require_depth(bench.world.observe_at(*path.start_pose))
        near = 255.0 * np.clip(1.0 - np.log1p(np.minimum(depth, 1e4)) / 5.0, 0.0, 1.0)
        photo = bench.world.photograph(planar_pose(*path.start_pose) @ bench.world.T_car_from_camera)
        for what, image in (
            ("view", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR)),
            ("depth", near.astype(np.uint8)),
            ("photograph", cv2.cvtColor(photo, cv2.COLOR_RGB2BGR)),
        ):
            write_atomically(folder / f"{name}_{what}.png", cv2.imencode(".png", image)[1].tobytes())
