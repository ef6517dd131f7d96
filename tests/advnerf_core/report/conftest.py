"""A report about a computed experiment: an analytic loop, drives with a known cross-track error, ray-cast views."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.geometry import Pinhole, camera_mount, make_transform, planar_pose, rotation_z
from advnerf_core.report import clips
from advnerf_core.report import data as rd
from advnerf_core.report.cells import CellResult
from advnerf_core.report.reference import DOMAINS
from advnerf_core.report.result_table import make_table

SIDE, RADIUS, SPEED, PERIOD, OFF_TRACK = 4.0, 1.1, 0.8, 0.1, 0.4
STRAIGHT = SIDE - 2 * RADIUS
LENGTH = 4 * (STRAIGHT + RADIUS * np.pi / 2)
CAMERA = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
BOARD = make_transform(rotation_z(np.pi - 0.14), np.array([3.15, -1.75, 0.42]))


def pose_at(s):
    """Pose [3] on a rounded square driven counter-clockwise from the start of its bottom straight."""
    leg = LENGTH / 4
    quarter, along = int(s % LENGTH // leg), s % leg
    if along <= STRAIGHT:
        local = np.array([along - STRAIGHT / 2, -SIDE / 2, 0.0])
    else:
        a = (along - STRAIGHT) / RADIUS
        local = np.array([STRAIGHT / 2 + RADIUS * np.sin(a), -SIDE / 2 + RADIUS * (1 - np.cos(a)), a])
    turn = quarter * np.pi / 2
    xy = rotation_z(turn)[:2, :2] @ local[:2]
    return np.array([*xy, local[2] + turn])


def offset_states(s, cte):
    """States [n, 3] at arc lengths s with cross-track error cte to the left."""
    poses = np.stack([pose_at(v) for v in s])
    normal = np.stack([-np.sin(poses[:, 2]), np.cos(poses[:, 2])], axis=1)
    yaw = poses[:, 2] + np.arctan2(np.gradient(cte), SPEED * PERIOD)
    return np.column_stack([poses[:, :2] + cte[:, None] * normal, yaw])


def drive(domain, condition, amplitude, seed=0, start=0, steps=60, victim="hardened", note=""):
    t = np.arange(steps + 1) * PERIOD
    rng = np.random.default_rng([seed, start, len(condition), len(domain)])
    ramp = 1 / (1 + np.exp(-(t - 3.4) * 2.0))
    cte = 0.03 * np.sin(2.1 * t + rng.uniform(0, 6)) + 0.02 * rng.standard_normal() - amplitude * ramp
    states = offset_states(-0.2 + 0.05 * start + SPEED * t, cte)
    return rd.Run(
        domain=domain,
        condition=condition,
        victim=victim,
        seed=seed,
        start=start,
        states=states,
        cte_m=cte,
        note=note,
    )


def table(drives, ticks=60, **changes):
    """The table of cells ``(domain, method, totals, off-track)`` of one seed; no attack costs 1 m from every start."""
    parts = {}
    for domain, method, totals, off_track in drives:
        driven = {"total_cte_m": totals, "off_track": off_track, "none_total_cte_m": [1.0] * len(totals)}
        parts.setdefault(method, {})[domain] = driven
    known = {"scenario": "track", "victim": "hardened", "seed": 0, "settings_hash": "h", "seconds": 1.0}
    known |= {"machine": "m", "date": "d", "extra": {"horizon": ticks}, **changes}
    cells = []
    for method, found in parts.items():
        cell = {**known, "method": method, "surrogate": next(iter(found.values())), **found}
        cells.append(CellResult.model_validate(cell))
    wanted = {("track", "hardened", name): (0,) for name in ("none", "random", "gradient")}
    return make_table(wanted, cells, "room")


def ray_cast(state, texture=None, camera=CAMERA):
    """What a camera on the car sees of an empty room with the tape on its floor and the board at the corner."""
    T = planar_pose(*state) @ camera_mount(0.30, 0.0, 0.20, np.radians(10.0))
    d = camera.directions() @ T[:3, :3].T
    o = T[:3, 3]
    with np.errstate(divide="ignore"):
        floor = np.where(d[..., 2] < -1e-6, -o[2] / d[..., 2], np.inf)
        walls = np.minimum(
            *(np.where(d[..., i] > 0, (4 - o[i]) / d[..., i], (-4 - o[i]) / d[..., i]) for i in (0, 1))
        )
    depth = np.minimum(floor, walls)
    p = o + depth[..., None] * d
    outside = np.maximum(np.abs(p[..., :2]) - (SIDE / 2 - RADIUS), 0.0)
    to_path = np.abs(np.hypot(outside[..., 0], outside[..., 1]) - RADIUS)
    shade = 0.5 + 0.06 * np.sin(3 * p[..., 0]) * np.sin(2.3 * p[..., 1]) + 0.05 * np.sin(5 * p[..., 2])
    rgb = np.where(
        (floor < walls)[..., None],
        shade[..., None] * [0.95, 0.9, 0.8],
        (shade + 0.2)[..., None] * [0.8, 0.9, 1.0],
    )
    rgb = np.where(((floor < walls) & (to_path < 0.025))[..., None], [0.12, 0.55, 0.25], rgb)
    normal, left = BOARD[:3, 0], BOARD[:3, 1]
    with np.errstate(divide="ignore", invalid="ignore"):
        hit = ((BOARD[:3, 3] - o) @ normal) / (d @ normal)
        q = o + hit[..., None] * d - BOARD[:3, 3]
    u, v = (q @ left) / 0.8 + 0.5, 0.5 - q[..., 2] / 0.8
    on = (hit > 0) & (hit < depth) & (np.abs(u - 0.5) < 0.5) & (np.abs(v - 0.5) < 0.5)
    face = np.full((8, 8, 3), [0.2, 0.6, 0.3]) if texture is None else texture / 255.0
    n = len(face)
    index = (
        (np.clip(v * n, 0, n - 1).astype(int), np.clip(u * n, 0, n - 1).astype(int)) if on.any() else (0, 0)
    )
    rgb = np.where(on[..., None], face[index], rgb)
    return (np.clip(rgb, 0, 1) * 255).astype(np.uint8)


def blurred(image, seed):
    """A surrogate's idea of an image: smoother, a little noisy."""
    rng = np.random.default_rng(seed)
    soft = cv2.GaussianBlur(image, (0, 0), 0.9).astype(float) + rng.normal(0, 3, image.shape)
    return np.clip(soft, 0, 255).astype(np.uint8)


def psnr(a, b):
    return 10 * np.log10(255**2 / np.mean((a.astype(float) - b.astype(float)) ** 2))


def colour_grid(seed, scale):
    rng = np.random.default_rng(seed)
    coarse = 1 / (1 + np.exp(-scale * rng.standard_normal((8, 8, 3))))
    return np.clip(cv2.resize(coarse, (64, 64), interpolation=cv2.INTER_LINEAR) * 255, 0, 255).astype(
        np.uint8
    )


def scene():
    path = np.stack([pose_at(s)[:2] for s in np.linspace(0, LENGTH, 240, endpoint=False)])
    monitor = make_transform(rotation_z(-2.4), np.array([3.0, 3.0, 0.5]))
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0], [-1.0, -1.0]])
    faces = {"board": rd.face_segment(BOARD, 0.8), "monitor": rd.face_segment(monitor, 0.5977)}
    return rd.Scene(
        path,
        OFF_TRACK,
        edges_m=(4.0 * square,),
        objects_m=(0.3 * square[:4],),
        faces_m=faces,
        fence_m=3.5 * square[:4],
    )


def drives(runs=(), curves=(), film=None):
    return rd.Drives("track", scene(), PERIOD, tuple(runs), tuple(curves), film)


def fidelity(count=24, shown=3):
    views = []
    for i, s in enumerate(np.linspace(0, LENGTH, count, endpoint=False)):
        real = ray_cast(pose_at(s))
        fake = blurred(real, i)
        small = [cv2.resize(im[40:151], (200, 66), interpolation=cv2.INTER_AREA) for im in (real, fake)]
        steering = 0.22 * (s % (LENGTH / 4) > STRAIGHT) - 0.02 * np.sin(i)
        views.append(
            rd.FidelityView(
                f"view {i:03d}",
                psnr(real, fake),
                psnr(*small),
                0.93,
                0.97,
                steering,
                steering + 0.012 * np.cos(3 * i),
                real if i % (count // shown) == 4 else None,
                fake if i % (count // shown) == 4 else None,
            )
        )
    return rd.Fidelity(tuple(views))


def laps():
    s = np.arange(0, 3 * LENGTH, SPEED * PERIOD)
    cte = 0.05 * np.sin(s * 1.7) + 0.02 * np.cos(s * 0.4)
    return rd.Laps(3, offset_states(s, cte), cte, np.abs(cte).mean(), bool((np.abs(cte) > OFF_TRACK).any()))


def latency():
    rng = np.random.default_rng(5)
    hops = {
        "camera to compositor": rng.gamma(6, 0.5, 900),
        "policy": rng.gamma(30, 0.4, 900),
        "motor": rng.gamma(4, 0.4, 900),
    }
    return rd.Latency(sum(hops.values()) + 2, 100.0, 0, hops)


def all_runs(starts=2, seeds=(0, 1, 2), victims=("hardened", "naive")):
    runs = []
    for victim in victims:
        weak = 2.2 if victim == "naive" else 1.0
        for domain in DOMAINS:
            scale = 1.0 if domain == "surrogate" else 0.92
            for start in range(starts):
                runs.append(drive(domain, "empty", 0.0, 0, start, victim=victim))
                runs.append(drive(domain, "none", 0.04, 0, start, victim=victim))
                for seed in seeds:
                    runs.append(drive(domain, "random", 0.05 * weak, seed, start, victim=victim))
                    amplitude = (0.62 + 0.05 * seed) * scale
                    note = (
                        "stopped by the fence at 5.8 s"
                        if (domain, start, seed, victim) == ("deployed", 0, 2, "naive")
                        else ""
                    )
                    runs.append(drive(domain, "gradient", amplitude, seed, start, victim=victim, note=note))
    return tuple(runs)


def manifest():
    return rd.Manifest(
        "advnerf experiment run launch/room.experiment.yaml --setting full",
        {"scene": "b1946ac92492d2347c6235b4d2611184", "policy": "591785b794601e212b260e25925636fd"},
        {"advnerf": "0.1.0", "numpy": np.__version__},
        {"processor": "x86_64, 2 cores", "memory": "8 GiB"},
        {"setting": "full", "horizon": "T = 60 control ticks of 0.1 s"},
        {"capture": 41.0, "scene": 610.0, "policy": 700.2, "cells": 3200.0},
    )


def make_clip(folder: Path, steps=60):
    texture = colour_grid(1, 3.0)
    tracks = []
    for title, domain, condition, amplitude, face in (
        ("no attack", "deployed", "none", 0.04, None),
        ("best random", "surrogate", "random", 0.1, colour_grid(9, 5.0)),
        ("attack", "deployed", "gradient", 0.6, texture),
    ):
        run = drive(domain, condition, amplitude, steps=steps)
        frames = [ray_cast(x, face) for x in run.states]
        frames = [blurred(f, i) for i, f in enumerate(frames)] if domain == "surrogate" else frames
        tracks.append(clips.ClipTrack(title, condition, frames, run.cte_m, "9f3a0c"))
    return clips.write_film(folder / "comparison.mp4", tracks, 10.0, OFF_TRACK)


def full_report(folder: Path, steps=60):
    rng = np.random.default_rng(2)
    grow = np.arange(1, 51)
    curves = [
        rd.LossCurve("gradient", 0.5 * (1 - np.exp(-grow / (12 + 3 * s))) + rng.normal(0, 0.01, 50))
        for s in (0, 1, 2)
    ]
    curves.append(rd.LossCurve("random", rng.gamma(2, 0.01, 50)))
    textures = [
        rd.Texture(f"gradient, seed {s}", "gradient", colour_grid(s, 3.0), f"9f3a{s}c") for s in (0, 1, 2)
    ]
    textures.append(rd.Texture("best random", "random", colour_grid(9, 5.0), "41b07e"))
    return rd.ReportData(
        (drives(all_runs(), curves, make_clip(folder, steps)),),
        manifest(),
        textures=tuple(textures),
        fidelity=fidelity(),
        live=True,
        latency=latency(),
        laps=laps(),
    )


@pytest.fixture(scope="session")
def report(tmp_path_factory):
    return full_report(tmp_path_factory.mktemp("clips"), steps=12)


@pytest.fixture
def bare_report():
    """Only what a report cannot do without."""
    return rd.ReportData(
        (drives(),),
        manifest(),
        live=True,
        not_measured={"latency": "No <live> drive."},
    )


@pytest.fixture(scope="session")
def make():
    """The builders above, for tests that need their own report."""
    import types

    return types.SimpleNamespace(
        table=table,
        drive=drive,
        drives=drives,
        scene=scene,
        manifest=manifest,
        ray_cast=ray_cast,
        full=full_report,
    )
