"""Registers an experiment: its cells and tests are written down before anything is run."""

from __future__ import annotations

from collections.abc import Sequence
from datetime import datetime, timezone
from importlib.metadata import version
from pathlib import Path

from advnerf_core.driving.metrics import mean_cte_limit_m
from advnerf_core.files import write_json
from advnerf_core.report.evidence.families import (
    COARSE_BASELINES,
    COARSE_GRADIENT,
    GRADIENT,
    RANDOM_ALONE,
    RANDOM_FAMILIES,
    lacking_baselines,
)
from advnerf_core.report.evidence.registration import (
    FILE,
    PrimaryTest,
    RegisteredScenario,
    Registration,
    SetError,
    read_registration,
)
from nodes.experiment.plan.carriers import FaceCarrier
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.object_kinds import PANEL
from nodes.experiment.plan.rules import check_options
from nodes.experiment.plan.space_config import ColoursConfig
from nodes.experiment.run.plan import registered_cell, statuses
from nodes.experiment.run.store import FINISHED
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import given_in, given_victim
from nodes.experiment.show.victims import look_at_given
from nodes.experiment.steps.attack import planned_evaluations
from nodes.experiment.steps.keys import own_recipes, pinned_code, registered_settings, require_searchable

# Families of random textures that judge a victim; `benchmarks.hardening` makes the verdicts.
VALIDATED_ON = ("random_natural",)


def register(experiment: Experiment, cells: Sequence[Cell], published: Path) -> Registration:
    """Write the registration of an experiment into its folder among all published sets.

    Raises:
        SetError: Another registration has this name, cells with these settings were run already, or a test lacks baselines.
    """
    found = Registration(
        name=experiment.config.name,
        file=experiment.file.name,
        setting=experiment.setting,
        overrides=experiment.overrides,
        date=datetime.now(timezone.utc).isoformat(timespec="seconds"),
        software_version=version("advnerf"),
        scenarios=_scenarios(experiment, cells),
        cells=tuple(registered_cell(cell) for cell in cells),
        primary=tuple(primary_tests(experiment, cells)),
        contrasts=experiment.config.contrasts,
        claims=experiment.config.claims,
    ).as_filed()
    folder = published / experiment.config.name
    before = read_registration(folder)
    if before is not None and before.digest == found.digest:
        return before
    if before is not None:
        raise SetError(
            f"{folder / FILE}: expected the same experiment as was registered on {before.date}, got another; remove the file, and the cells "
            "published beside it, to register anew"
        )
    _refuse_late(experiment, cells)
    write_json(folder / FILE, found.model_dump(mode="json"))
    return found


def _scenarios(experiment: Experiment, cells: Sequence[Cell]) -> dict[str, RegisteredScenario]:
    found: dict[str, RegisteredScenario] = {}
    for cell in cells:
        if cell.scenario not in found:
            variant = experiment.of(cell)
            look_at_given(variant)  # their hashes are fixed before anything is run
            variant.ask_world()
            found[cell.scenario] = registered_scenario(variant, cell.path)
    require_searchable(experiment, cells)
    for variant in {cell.variant: experiment.of(cell) for cell in cells}.values():
        check_options(variant.config.methods, variant.config.attack)
    return found


def registered_scenario(experiment: Experiment, name: str) -> RegisteredScenario:
    """The registration of one path of an experiment, whose world and victims are known."""
    config, limits = experiment.config, experiment.limits
    found = {name: given_victim(experiment, name) for name in given_in(config)}
    settings, own = registered_settings(experiment), own_recipes(config)
    starts = [(float(x), float(y), float(yaw)) for x, y, yaw in experiment.measured_starts(name).tolist()]
    deployed = 0 if config.deploy.through == "nothing" else len(starts[: config.deploy.starts])
    return RegisteredScenario(
        settings_sha256=settings.key,
        settings={**settings.resolved, **pinned_code(config)},
        path=experiment.paths[name].to_dict(),
        ticks=limits.ticks,
        dt_s=limits.dt_s,
        off_track_m=limits.off_track_m,
        held_cap_m=limits.held_cap_m,
        starts=tuple(starts),
        deployed_starts=deployed,
        evaluations=planned_evaluations(experiment),
        space=config.space.model_dump(mode="json"),
        victims={
            **(config.policy.recipe if len(own) < len(config.trained) else {}),
            **({"recipes": own} if own else {}),
            **({"policies": {each: policy.sha256 for each, policy in found.items()}} if found else {}),
        },
        drives_well_mean_cte_m=mean_cte_limit_m(limits.off_track_m),
    )


def primary_tests(experiment: Experiment, cells: Sequence[Cell]) -> list[PrimaryTest]:
    """The tests on the main victim, per variant and path: the gradient against all baselines, and the coarse gradient against coarse ones.

    Baselines are the methods whose textures neither trained nor judged the victim; of places and shapes it is ``random``. A place without
    baselines has no test, and neither has one of a claim over places: that samples places, not the searches at one of them.

    Raises:
        SetError: A place with a baseline lacks others that a test needs, or nothing is deployed there.
    """
    tests = []
    sampled = {name for each in experiment.config.claims for name in each.scenarios}
    for scenario in dict.fromkeys(cell.scenario for cell in cells):
        found = [each for each in cells if each.scenario == scenario]
        config = experiment.of(found[0]).config
        victim = config.main_victim
        trained_on = config.training(victim).policy.families
        ran = dict.fromkeys(cell.method for cell in found if cell.victim == victim and cell.searched)
        of_textures = config.space.kind not in RANDOM_ALONE
        # Textures of the other families neither trained nor judged the victim.
        methods = [name for name in ran if not of_textures or name not in (*trained_on, *VALIDATED_ON)]
        against = [name for name in methods if name not in (GRADIENT, COARSE_GRADIENT)]
        if GRADIENT not in methods or not against:
            continue
        if config.deploy.through == "nothing":
            raise SetError(
                f"{scenario}: expected deploy.through world or nodes, as its tests are about deployed drives, got nothing; deploy them, or leave "
                f"{GRADIENT} or its baselines out of the methods"
            )
        families = [name for name in RANDOM_FAMILIES if name not in (*trained_on, *VALIDATED_ON)]
        lacking = lacking_baselines(methods, _coarse_cells_differ(config), families)
        if of_textures and lacking:
            raise SetError(
                f"{scenario}: expected the baselines that a test of the gradient needs, got {', '.join(against)} "
                f"(textures of {', '.join(trained_on)} train the victim, those of {', '.join(VALIDATED_ON)} judge it); add {'; '.join(lacking)} to "
                "the methods"
            )
        if scenario in sampled:
            continue
        coarse = [name for name in against if name in COARSE_BASELINES] if COARSE_GRADIENT in methods else []
        tests += [
            PrimaryTest(scenario=scenario, victim=victim, method=method, against=tuple(names))
            for method, names in ((GRADIENT, against), (COARSE_GRADIENT, coarse))
            if names
        ]
    return tests


def _coarse_cells_differ(config: ExperimentConfig) -> bool:
    """Whether coarse textures have another number of cells than the gradient's, if this can be known: on a face, or on one panel."""
    space, carrier = config.space, config.carrier
    if not isinstance(space, ColoursConfig):
        return False
    if isinstance(carrier, FaceCarrier):
        return 0 < space.cells < carrier.resolution
    panel = len(config.objects) == 1 and config.objects[0].kind == PANEL
    return panel and 0 < space.cells < config.object.panel_resolution


def _refuse_late(experiment: Experiment, cells: Sequence[Cell]) -> None:
    done = [
        each.cell.name
        for each in statuses(experiment, cells)
        if each.state in (*FINISHED, "begun", "running")
    ]
    if done:
        raise SetError(
            f"expected to register before anything is run, got {len(done)} cells that are there or begun, such as {done[0]}; "
            "name another run folder, or other seeds"
        )
