"""Changes of what was registered, with everything renewed, and changes that are committed."""

from __future__ import annotations

import shutil

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.kept import KeptDrive
from advnerf_core.report.evidence.page import film_of, picture_of
from advnerf_core.report.evidence.publishing import write_page
from advnerf_core.report.evidence.registration import FILE
from advnerf_core.report.evidence.verifying.layout import DIGESTS
from benchmarks.planting.of_cells import a_later_date
from benchmarks.planting.world import Data, World


def another_limit(world: World) -> None:
    """Another off-track limit, in the registration alone."""
    data, _ = _limit(world)
    world.register_again(data)
    _totals_again(world)
    world.renew_all()


def another_limit_everywhere(world: World) -> None:
    """Another off-track limit, in the registration and in all cells."""
    data, factor = _limit(world)
    world.register_again(data)
    for file in sorted(world.folder.glob("*.json")):
        cell = read_json(file)
        cell["extra"]["off_track_m"] *= factor
        world.put(file, cell)
    _totals_again(world)
    world.renew_all()


def a_dropped_scenario(world: World) -> None:
    """A condition that was never registered, after all."""
    data = read_json(world.folder / FILE)
    name = world.rng.choice(sorted(data["scenarios"]))
    del data["scenarios"][name]
    for part in ("cells", "primary"):
        data[part] = [each for each in data[part] if each["scenario"] != name]
    data["contrasts"] = [
        each for each in data.get("contrasts", []) if name not in (each["before"], each["after"])
    ]
    data["claims"] = [each for each in data.get("claims", []) if name not in each["scenarios"]]
    for file in [*world.folder.glob(f"{name}_*.json"), *world.folder.glob(f"*/{name}_*.json")]:
        file.unlink()
    world.register_again(data)
    world.renew_all()


def a_dropped_search(world: World) -> None:
    """A search that was never registered, after all."""
    file, cell = world.some_search()
    data = read_json(world.folder / FILE)
    data["cells"] = [each for each in data["cells"] if not _is(each, cell)]
    file.unlink()
    (world.folder / "predictions" / file.name).unlink(missing_ok=True)
    world.register_again(data)
    world.renew_all()


def an_earlier_registration(world: World) -> None:
    """A registration of an earlier day."""
    data = read_json(world.folder / FILE)
    world.put(world.folder / FILE, {**data, "date": f"2025-0{world.rng.randint(1, 9)}-01T00:00:00+00:00"})
    world.renew_all()


def fewer_tests(world: World) -> None:
    """A test that was never to be claimed, so that the others are adjusted less."""
    data = read_json(world.folder / FILE)
    data["primary"].remove(world.rng.choice(data["primary"]))
    world.register_again(data)
    world.renew_all()


def another_rule_of_driving_well(world: World) -> None:
    """A larger mean |CTE| that still passes for driving well."""
    data = read_json(world.folder / FILE)
    for each in data["scenarios"].values():
        each["drives_well_mean_cte_m"] *= world.rng.uniform(1.5, 3.0)
    world.register_again(data)
    world.renew_all()


def a_changed_registration_is_committed(world: World) -> None:
    """Another limit everywhere, committed after the cells."""
    another_limit_everywhere(world)
    world.commit(".")


def a_changed_cell_is_committed(world: World) -> None:
    """Another drive of a cell, committed after it had been published."""
    a_later_date(world)
    world.commit(".")


def cells_before_their_registration(world: World) -> None:
    """The registration is committed after its cells."""
    file = world.folder / FILE
    text = file.read_text()
    file.unlink()
    world.commit(".")
    file.write_text(text)
    world.commit(".")


def a_removed_set(world: World) -> None:
    """The set is gone, with everything of it, committed or not."""
    shutil.rmtree(world.folder)
    for file in (film_of(world.name), picture_of(world.name)):
        (world.published / file).unlink(missing_ok=True)
    known = read_json(world.published / DIGESTS)
    world.put(world.published / DIGESTS, {name: each for name, each in known.items() if name != world.name})
    write_page(world.published)
    world.renew_rows(read_json(world.ledger))
    if world.rng.random() < 0.5:
        world.commit(".")


def _limit(world: World) -> tuple[Data, float]:
    data, factor = read_json(world.folder / FILE), world.rng.choice([0.5, 0.8, 1.25])
    for each in data["scenarios"].values():
        each["off_track_m"] *= factor
    return data, factor


def _totals_again(world: World) -> None:
    """Whether each drive left the track, under the limit of now."""
    registration = world.registration()
    for file in sorted(world.folder.glob("*.json")):
        cell = read_json(file)
        scenario = registration.scenarios[cell["scenario"]]
        path = scenario.reference_path()
        for domain, drives in cell["kept"].items():
            found = [KeptDrive.model_validate(each).metrics(path, scenario.horizon) for each in drives]
            cell[domain]["off_track"] = [each.off_track for each in found]
        world.put(file, cell)


def _is(registered: Data, cell: Data) -> bool:
    keys = ("scenario", "victim", "method", "seed")
    return all(registered[key] == cell[key] for key in keys)
