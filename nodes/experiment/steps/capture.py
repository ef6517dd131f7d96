"""Stage capture: photograph the world, and store its description and held-out views of the driving camera."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.posed_images import write_posed_images
from advnerf_core.files import write_json
from advnerf_core.geometry import Array, Pinhole, planar_pose
from advnerf_core.learning.recipe import recovery_states
from calibration.by_construction import write_twin_calibrations
from calibration.schema import save_calibration
from hardware.worlds.lab.lab import Lab
from hardware.worlds.world import Photograph, Photographed, World
from nodes.experiment.show.context import CALIBRATION, PLACED, Experiment
from nodes.experiment.show.faces import DISPLAY, on_screen, panel_of, plain_screen, wanted_face
from nodes.experiment.show.learned_scene import HELD_OUT
from nodes.experiment.show.light import LIGHT, light_remark, measure_light
from nodes.experiment.show.placing import place_by_rule
from nodes.experiment.show.screen import measure_display, screens_of
from nodes.runtime.progress import Report, counted

PHOTOS, COLOUR_PAIRS = "photos", "colour_pairs"
# Held-out views lie as far from a path as a fooled car drives [m, for half a lane of 1.75 m], and as turned [rad].
_LATERAL_M, _HEADING_RAD = 1.0, 0.2


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``world.json``, the places of objects with a rule, and posed image sets: ``photos`` (for learning), ``held_out`` and ``colour_pairs`` (driving camera, without objects)."""
    config = experiment.config.capture
    rng = np.random.default_rng(config.seed)
    with experiment.open_world() as scene:
        experiment.keep_world(scene)
        if isinstance(scene, Photographed):
            _take_over(scene, config.held_out, folder, report)
            return
        if experiment.has_rules:
            report(0.0, "placing objects")
            write_json(folder / PLACED, [each.place for each in place_by_rule(experiment, scene)])
        if experiment.config.carrier.response == "measured":
            report(0.0, "measuring the light on the panel")
            save_calibration(measure_light(experiment, scene).calibration(), folder / CALIBRATION / LIGHT)
        elif experiment.config.carrier.kind == "native" and (said := light_remark(experiment, scene)):
            print(said, flush=True)
        _calibrate(experiment, scene, folder / CALIBRATION, report)
        poses = scene.photo_poses(config.photos, rng)
        write_posed_images(
            folder / PHOTOS,
            poses,
            scene.photo_pinhole,
            lambda index: scene.photograph(poses[index]),
            "jpg",
            keep=True,
            told=counted(
                report, PHOTOS, len(poses), 0, config.photos + config.held_out + config.colour_pairs
            ),
        )
        for name, count, done in (
            (HELD_OUT, config.held_out, config.photos),
            (COLOUR_PAIRS, config.colour_pairs, config.photos + config.held_out),
        ):
            if count:
                _driving_views(experiment, scene, name, count, rng, done, folder, report)


def _take_over(place: Photographed, held_out: int, folder: Path, report: Report) -> None:
    """Import both sets of a place that is known by photographs."""
    learned, views = place.photographs(held_out)
    total = len(learned) + len(views)
    _write(folder / PHOTOS, learned, counted(report, PHOTOS, len(learned), 0, total))
    _write(folder / HELD_OUT, views, counted(report, HELD_OUT, len(views), len(learned), total))


def _write(folder: Path, photographs: Sequence[Photograph], told: Callable[[int], None]) -> None:
    pinholes: list[Pinhole] = []  # known once a photograph is undistorted

    def look(index: int) -> NDArray[np.uint8]:
        rgb, pinhole = photographs[index].look()
        pinholes.append(pinhole)
        return rgb

    # The images are learned from and compared with, so they are stored without further loss.
    write_posed_images(
        folder,
        [each.T_world_from_camera for each in photographs],
        pinholes,
        look,
        "png",
        valid=[each.valid for each in photographs],
        told=told,
    )


def _driving_views(
    experiment: Experiment,
    scene: World,
    name: str,
    count: int,
    rng: np.random.Generator,
    done: int,
    folder: Path,
    report: Report,
) -> None:
    """A set of views of the driving camera around the paths."""
    config, states = (
        experiment.config.capture,
        states_about(experiment, count, rng, experiment.config.capture.driven_m),
    )

    def observed(index: int) -> NDArray[np.uint8]:
        x, y, yaw = map(float, states[index])
        return scene.observe_at(x, y, yaw, depth=False)[0]

    write_posed_images(
        folder / name,
        [planar_pose(*state) @ experiment.mount for state in states],
        experiment.camera,
        observed,
        "png",
        keep=True,
        told=counted(report, name, count, done, config.photos + config.held_out + config.colour_pairs),
    )


def _calibrate(experiment: Experiment, scene: World, folder: Path, report: Report) -> None:
    """Write files for live nodes, and the colours of a screen that carries the attack, which then shows the plain face."""
    if isinstance(scene, Lab):
        write_twin_calibrations(scene.config, folder)
    if on_screen(experiment):
        report(0.0, "measuring the screen's colours")
        name, panel = wanted_face(experiment).panel, panel_of(experiment)
        fit = measure_display(scene, name, panel, experiment.config.capture.seed)
        folder.mkdir(parents=True, exist_ok=True)
        save_calibration(fit.calibration(), folder / DISPLAY)
        screens_of(scene).show(name, plain_screen(experiment))


def states_about(
    experiment: Experiment,
    count: int,
    rng: np.random.Generator,
    driven_m: float,
    lateral_m: float = _LATERAL_M,
    heading_rad: float = _HEADING_RAD,
) -> Array:
    """Car states ``[count, 3]`` around all paths, or their first ``driven_m`` [m], up to this far from the path (for half a lane of 1.75 m) and this much turned."""
    names = list(experiment.paths)
    parts = []
    for index, name in enumerate(names):
        path, share = experiment.paths[name], len(range(index, count, len(names)))
        reach_m = None if path.closed else min(driven_m, path.length_m)
        parts.append(recovery_states(path, share, rng, experiment.across_m(lateral_m), heading_rad, reach_m))
    return np.concatenate(parts)
