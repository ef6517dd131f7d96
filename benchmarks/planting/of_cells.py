"""Changes of cells and of what lies beside them, with digests or everything renewed."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from advnerf_core.documents import read_json
from advnerf_core.report.cells import cell_name
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.verifying.victims import DECLARED
from benchmarks.planting.world import Data, World, is_searched, poses_of

Floats = NDArray[np.float64]


def a_dropped_drive(world: World) -> None:
    """One drive fewer, with its totals."""
    file, data = world.some_cell()
    domain, number = world.some_drive(data)
    for values in (
        data["kept"][domain],
        *(data[domain][key] for key in ("total_cte_m", "off_track", "none_total_cte_m")),
    ):
        del values[number]
    world.put(file, data)
    world.renew_all()  # fmt: skip


def a_strange_cell(world: World) -> None:
    """A search that was not registered and says that it was."""
    file, data = world.some_search()
    data |= {"seed": 99, "attack_id": f"{world.rng.getrandbits(48):012x}"}
    name = cell_name(data["scenario"], data["victim"], data["method"], 99)
    data["extra"].pop("clip", None)
    world.put(file.with_name(f"{name}.json"), data)
    world.renew_all()


def another_victim(world: World) -> None:
    """Another policy than that of the other cells."""
    file, data = world.some_cell()
    other = f"{world.rng.getrandbits(256):064x}"
    change = (
        {"policy_sha256": other}
        if world.rng.random() < 0.5
        else {"stages": {**data["stages"], "policy": other}}
    )
    world.put(file, {**data, **change})
    world.renew_all()


def another_start(world: World) -> None:
    """A drive from another start, moved by a decimetre or more."""

    def move(poses: Floats, direction: Floats) -> None:
        poses[:, :2] += world.rng.uniform(0.1, 0.3) * direction

    _move(world, move)


def a_leap(world: World) -> None:
    """A car that leaps by some steps at once, and drives on from there."""

    def leap(poses: Floats, direction: Floats) -> None:
        at = world.rng.randrange(len(poses) // 4, len(poses) // 2)
        poses[at:, :2] += world.rng.uniform(1.5, 4.0) * _step_m(poses) * direction

    _move(world, leap)


def wider_poses(world: World) -> None:
    """A drive whose distance from its start line is scaled, the headings left."""
    file, data = world.some_search()
    domain, number = world.some_drive(data)
    poses = poses_of(data, domain, number)
    world.set_drive(data, domain, number, _wider(poses, world.rng.uniform(1.2, 1.6)))
    world.put(file, data)
    world.renew_all()


def stronger_drives(world: World) -> None:
    """All deployed drives of the attack turn away further from those without attack, as the car can drive."""
    factor = world.rng.uniform(1.05, 1.3)
    for file in sorted(world.folder.glob("*_gradient_*.json")):
        data = read_json(file)
        name = cell_name(data["scenario"], data["victim"], "none", 0)
        clean = read_json(world.folder / f"{name}.json")
        for number in range(len(data["kept"]["deployed"])):
            attacked, other = (poses_of(each, "deployed", number) for each in (data, clean))
            world.set_drive(data, "deployed", number, _turned_further(attacked, other, factor))
        world.put(file, data)
    world.renew_all()


def a_copied_drive(world: World) -> None:
    """The drive of another search, from the same start."""
    file, data = world.some_search()
    wanted = ("scenario", "victim")
    _, other = world.some_cell(
        lambda each: (
            is_searched(each)
            and each["seed"] != data["seed"]
            and all(each.get(key) == data.get(key) for key in wanted)
        )
    )
    domain, number = world.some_drive(data)
    world.set_drive(data, domain, number, poses_of(other, domain, number))
    data["kept"][domain][number] = other["kept"][domain][number]
    world.put(file, data)
    world.renew_all()  # fmt: skip


def swapped_seeds(world: World) -> None:
    """Two searches of one method under one condition change seeds."""
    file, data = world.some_search()
    wanted = ("scenario", "victim", "method")
    other_file, other = world.some_cell(
        lambda each: each["seed"] != data["seed"] and all(each.get(key) == data.get(key) for key in wanted)
    )
    data["seed"], other["seed"] = other["seed"], data["seed"]
    for each in (data, other):
        each["extra"].pop("clip", None)
    world.put(file, other)
    world.put(other_file, data)
    world.renew_all()


def a_shared_attack(world: World) -> None:
    """Two searches that have one attack."""
    file, data = world.some_search()
    _, other = world.some_cell(
        lambda each: is_searched(each) and (each["method"], each["seed"]) != (data["method"], data["seed"])
    )
    world.put(file, {**data, "attack_id": other["attack_id"]})
    world.renew_all()


def more_evaluations(world: World) -> None:
    """Searches of a method with more evaluations than registered."""
    _notes(world, {"evaluations": world.rng.choice([100, 200, 1000])})


def another_space(world: World) -> None:
    """Searches of a method in a larger space than registered."""
    _notes(world, {"space": {"kind": "colours", "cells": world.rng.choice([16, 64])}})


def an_earlier_date(world: World) -> None:
    """A cell from before its registration."""
    file, data = world.some_cell()
    world.put(file, {**data, "date": f"2025-0{world.rng.randint(1, 9)}-01T00:00:00+00:00"})
    world.renew_all()


def a_later_date(world: World) -> None:
    """A cell that was run on another day after its registration."""
    file, data = world.some_cell()
    world.put(file, {**data, "date": f"2027-0{world.rng.randint(1, 9)}-01T00:00:00+00:00"})
    world.renew_all()


def driven_elsewhere(world: World) -> None:
    """All cells say that they were deployed through something else."""
    for file in sorted(world.folder.glob("*.json")):
        data = read_json(file)
        data["extra"]["deployed_through"] = "nodes"
        world.put(file, data)
    world.renew_all()


def a_bad_victim(world: World) -> None:
    """A victim that weaves without attack, in drives of its own that agree."""
    file, data = world.some_cell(lambda each: each["method"] == "none")
    limit_m = read_json(world.folder / FILE)["scenarios"][data["scenario"]]["off_track_m"]
    for number in range(len(data["kept"]["deployed"])):
        poses = poses_of(data, "deployed", number)
        aside_m = (
            world.rng.uniform(0.6, 0.9) * limit_m * (1.0 - np.cos(np.linspace(0.0, 2.0 * np.pi, len(poses))))
        )
        normal = np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1)
        poses[:, :2] += aside_m[:, None] * normal
        world.set_drive(data, "deployed", number, _turned_along(poses))
    world.put(file, data)
    for each in sorted(world.folder.glob("*.json")):
        cell = read_json(each)
        if (cell["scenario"], cell["victim"]) == (data["scenario"], data["victim"]):
            cell["deployed"]["none_total_cte_m"] = data["deployed"]["total_cte_m"]
            world.put(each, cell)
    (world.folder / DECLARED).unlink(missing_ok=True)
    world.renew_all()


def a_verdict_of_the_gate(world: World) -> None:
    """A verdict of the gate that is turned, or has other numbers."""
    file = world.rng.choice(sorted(world.folder.glob("gate/*.json")))
    data = read_json(file)
    if world.rng.random() < 0.5:
        data["passed"] = not data["passed"]
    else:
        data["numbers"]["psnr_db"] += world.rng.uniform(1.0, 5.0)
    world.put(file, data)
    world.renew_digests()


def a_prediction(world: World) -> None:
    """A prediction that turns out better: its middle, or a wider band."""
    file = world.rng.choice(sorted(world.folder.glob("predictions*/*.json")))
    data = read_json(file)
    if world.rng.random() < 0.5:
        data["excess_m"] *= world.rng.uniform(1.05, 1.3)
    else:
        data |= {"excess_low_m": 0.5 * data["excess_low_m"], "excess_high_m": 2.0 * data["excess_high_m"]}
    world.put(file, data)
    world.renew_digests()


def a_prediction_of_other_settings(world: World) -> None:
    """A prediction that was made with other settings than its cell was run with."""
    file = world.rng.choice(sorted(world.folder.glob("predictions*/*.json")))
    world.put(file, {**read_json(file), "settings_hash": f"{world.rng.getrandbits(256):064x}"})
    world.renew_digests()


def _notes(world: World, notes: Data) -> None:
    _, some = world.some_search()
    for file in sorted(world.folder.glob("*.json")):
        data = read_json(file)
        if data["method"] == some["method"]:
            data["extra"] |= notes
            world.put(file, data)
    world.renew_all()


def _move(world: World, change: Callable[[Floats, Floats], None]) -> None:
    file, data = world.some_search()
    domain, number = world.some_drive(data)
    poses, turned = poses_of(data, domain, number), world.rng.uniform(-np.pi, np.pi)
    change(poses, np.array([np.cos(turned), np.sin(turned)]))
    world.set_drive(data, domain, number, poses)
    world.put(file, data)
    world.renew_all()


def _step_m(poses: Floats) -> float:
    return float(np.hypot(*np.diff(poses[:, :2], axis=0).T).max())


def _wider(poses: Floats, factor: float) -> Floats:
    """Poses with their distance from the line through the start, along its heading, scaled."""
    normal = np.array([-np.sin(poses[0, 2]), np.cos(poses[0, 2])])
    aside_m = (poses[:, :2] - poses[0, :2]) @ normal
    wider = poses.copy()
    wider[:, :2] += (factor - 1.0) * aside_m[:, None] * normal
    return wider


def _turned_along(poses: Floats) -> Floats:
    """Poses with headings along their motion."""
    steps = np.diff(poses[:, :2], axis=0)
    directions = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turned = poses.copy()
    turned[1:-1, 2] = (directions[:-1] + directions[1:]) / 2.0
    turned[-1, 2] = directions[-1]
    return turned


def _turned_further(poses: Floats, clean: Floats, factor: float) -> Floats:
    """Poses of a drive whose headings differ from another one's by more, with its own steps along them."""
    steps = np.diff(poses[:, :2], axis=0)
    headings = np.unwrap(poses[:, 2])
    other = np.unwrap(clean[:, 2])
    new = headings + (factor - 1.0) * (headings - other - (headings[0] - other[0]))
    turned = (new - headings)[:-1] + np.diff(new - headings) / 2.0
    moved = np.stack(
        [
            np.cos(turned) * steps[:, 0] - np.sin(turned) * steps[:, 1],
            np.sin(turned) * steps[:, 0] + np.cos(turned) * steps[:, 1],
        ],
        axis=1,
    )
    places = poses[0, :2] + np.concatenate([np.zeros((1, 2)), np.cumsum(moved, axis=0)])
    return np.column_stack([places, new])
