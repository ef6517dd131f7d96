"""Stage bake: bake the learned scene for fast rendering, and compare it with the field on held-out views."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.files import finite_or_none, write_json
from advnerf_core.geometry import Array, planar_poses
from advnerf_core.scene.bake import NotBakedError
from advnerf_core.scene.baked import BakedScene
from advnerf_core.scene.metrics import psnr
from advnerf_core.splats.scene_file import bake_scene
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.learned_scene import FIDELITY, HELD_OUT, baked_file, captured, load_field
from nodes.experiment.steps.capture import states_about
from nodes.runtime.progress import Report

# Like a stage's version (`pipeline.VERSIONS`). It is part of the keys of results through baked scenes; this stage's digest is not, as its
# output follows from the scene, and machines differ in the last bits.
VERSION = 1
# The same for scenes of the user's own. Since 2, fields are baked, too: a search through the field does not go on through voxels.
OWN_VERSION = 2
COMPARED = "baked.json"
# Largest loss by baking on held-out views [dB]; a scene that loses more is rendered from its field. Where finished attacks are measured in the
# baked scene too, as in audits, its steering is what the gate compares with real pictures: baking may then double the field's own error.
_MOST_LOST_DB = {"field": 0.3, "baked": 10.0 * np.log10(2.0)}
# Views for which bricks are made: as far from a path as an attack may divert a car [m, for half a lane of 1.75 m], and as turned [rad].
_VIEWS, _LATERAL_M, _HEADING_RAD, _SEED = 320, 3.0, 0.5, 0
# A scene of the user's own is searched through its voxels if these look like it; finished attacks are judged in the scene itself.
_LEAST_ALIKE_DB, _COMPARED_VIEWS = 25.0, 16


def run(experiment: Experiment, folder: Path, report: Report) -> None:
    """Write ``baked.safetensors``, unless the scene cannot be baked or loses quality, and ``baked.json``, which says which."""
    field = load_field(experiment)
    own = experiment.given_scene is not None
    if not own and field.config.contraction and not experiment.config.scene.bake_unbounded:
        why = "expected a scene within its box, or scene.bake_unbounded, got one that extends outside it"
        write_json(folder / COMPARED, {"used": False, "why": why})
        return
    report(0.0, "baking")
    try:
        baked = bake_scene(field, views_of(experiment), experiment.view.pinhole)
    except NotBakedError as error:
        write_json(folder / COMPARED, {"used": False, "why": str(error)})
        return
    report(0.8, "comparing")
    used, found = (_beside_itself if own else _beside_views)(experiment, baked)
    if used:
        baked.save(baked_file(experiment))
    write_json(folder / COMPARED, {"used": used, **found, "mib": baked.voxels.nbytes / 2**20})


def _beside_views(experiment: Experiment, baked: BakedScene) -> tuple[bool, dict[str, float | None]]:
    """Whether a baked scene is used, and by what: the loss by baking on held-out views."""
    fidelity = read_json(experiment.stage_folder("scene") / FIDELITY)
    before_db, after_db = fidelity["mean"]["psnr_policy_db"], _held_out_psnr_db(experiment, baked)
    most_lost_db = float(_MOST_LOST_DB[experiment.config.measure.scene])
    found = {"psnr_field_db": before_db, "psnr_baked_db": after_db, "most_lost_db": most_lost_db}
    return before_db - after_db <= most_lost_db, found


def _beside_itself(experiment: Experiment, baked: BakedScene) -> tuple[bool, dict[str, float | None]]:
    """The same for a scene of the user's own, of which there are no held-out views: it is compared itself."""
    scene, pinhole = load_field(experiment), experiment.view.pinhole
    found_db = [
        psnr(baked.render(pose[None], pinhole)[0].numpy(), scene.render(pose[None], pinhole)[0].numpy())
        for pose in views_of(experiment)[:: _VIEWS // _COMPARED_VIEWS]
    ]
    mean_db = float(np.mean(found_db))
    return mean_db >= _LEAST_ALIKE_DB, {
        "psnr_to_scene_db": finite_or_none(mean_db),
        "least_db": _LEAST_ALIKE_DB,
    }


def views_of(experiment: Experiment) -> Array:
    """Poses ``[N, 4, 4]`` of the driving camera around all paths, equally many around each."""
    count = len(experiment.paths) * (_VIEWS // len(experiment.paths))
    driven_m = experiment.config.horizon * experiment.config.dt_s * experiment.car.speed_mps
    rng = np.random.default_rng(_SEED)
    states = states_about(experiment, count, rng, driven_m, _LATERAL_M, _HEADING_RAD)
    return planar_poses(states) @ experiment.mount


def _held_out_psnr_db(experiment: Experiment, baked: BakedScene) -> float:
    """Mean over the held-out views in the policy's view."""
    views = captured(experiment, HELD_OUT).load()
    view = experiment.view
    pairs = zip(views.rgb, views.T_world_from_camera, strict=True)
    return float(
        np.mean(
            [
                psnr(baked.render(pose[None], view.pinhole)[0][0].numpy(), view.image(rgb) / 255.0)
                for rgb, pose in pairs
            ]
        )
    )
