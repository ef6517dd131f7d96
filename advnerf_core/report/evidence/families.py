"""Baselines that a registered set must run: families of random textures, a coarse search, and the gradient with the cells of both."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence

from advnerf_core.report.conditions import CONTROLS, style_of
from advnerf_core.report.evidence.registration import RegisteredScenario, Registration

RANDOM_FAMILIES = ("random", "random_coarse", "random_levels", "random_pink", "random_natural")
# These search a coarse texture by the policy's answers alone.
COARSE_SEARCHES = ("cem", "evolution")
GRADIENT, COARSE_GRADIENT = "gradient", "gradient_coarse"
# Baselines whose texture has `cells` cells along an edge; all others have the object's.
COARSE_BASELINES = ("random_coarse", *COARSE_SEARCHES)
LEAST_FAMILIES = 3
# Spaces by their names in experiments that ``random`` alone searches without a gradient: what it draws there are places or shapes, no textures.
RANDOM_ALONE = ("places", "mesh_shape")


def lacking_baselines(methods: Collection[str], other_cells: bool, families: Sequence[str]) -> list[str]:
    """Baselines that a set with a primary test of the gradient lacks, as text; empty if complete.

    Args:
        methods: Methods of one scenario, except those that the victim was trained or validated on.
        other_cells: Whether coarse textures have fewer cells than the object.
        families: Families of random textures that may be baselines.
    """
    ran = sum(name in methods for name in families)
    found = []
    if ran < LEAST_FAMILIES:
        others = ", ".join(name for name in families if name not in methods)
        found.append(f"{LEAST_FAMILIES - ran} more of the random textures {others}")
    if not any(name in methods for name in COARSE_SEARCHES):
        found.append(f"a coarse search ({' or '.join(COARSE_SEARCHES)})")
    if other_cells and COARSE_GRADIENT not in methods:
        found.append(f"{COARSE_GRADIENT}, as coarse textures have other cells than the gradient's")
    return found


def coarse_cells_differ(scenario: RegisteredScenario) -> bool:
    """Whether the coarse textures of a scenario have another number of cells than its gradient.

    Registrations without settings do not give a panel's number of cells; such a panel counts as finer than its coarse textures.
    """
    cells, settings = int(scenario.space.get("cells", 0)), scenario.settings
    of_panel = settings.get("object", scenario.space).get("panel_resolution", cells + 1)
    return 0 < cells < int(settings.get("carrier", scenario.space).get("resolution", of_panel))


def families_note(registration: Registration) -> list[str]:
    """Sentences for the page: baselines of the primary tests, and missing ones; empty without primary tests."""
    said = dict.fromkeys(_note(registration, scenario) for scenario in registration.scenarios)
    return [f"{text}\n" for text in said if text]


def _note(registration: Registration, key: str) -> str:
    tests = [test for test in registration.primary if test.scenario == key]
    if not tests:
        return ""
    against = list(dict.fromkeys(method for test in tests for method in test.against))
    scenario = registration.scenarios[key]
    if scenario.space.get("kind") in RANDOM_ALONE:
        return "*Baseline*: random places or shapes, with as many evaluations."
    marks = list(_marks(against, _methods(registration, key), scenario))
    verdict = f" **{'; '.join(marks)}.**" if marks else ""
    return f"*Baselines*: {', '.join(style_of(name).title for name in against)}, each with as many evaluations as the attack.{verdict}"


def _methods(registration: Registration, key: str) -> set[str]:
    cells = [cell for cell in registration.cells if cell.scenario == key]
    return {cell.method for cell in cells if cell.method not in CONTROLS}


def _marks(against: Sequence[str], ran: Collection[str], scenario: RegisteredScenario) -> Iterator[str]:
    families = [name for name in against if name in RANDOM_FAMILIES]
    if len(families) < LEAST_FAMILIES:
        yield {0: "No family of random textures", 1: "One family of random textures only"}.get(
            len(families), f"{len(families)} families of random textures only"
        )
    if not any(name in COARSE_SEARCHES for name in against):
        yield "no coarse search"
    coarse = [name for name in against if name in COARSE_BASELINES]
    if coarse and COARSE_GRADIENT not in ran and coarse_cells_differ(scenario):
        yield f"baseline of other cells ({', '.join(style_of(name).title for name in coarse)}) than the gradient's"
