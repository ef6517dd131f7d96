"""All kinds of changes, and who can see each: the files, the history in git, or only a second party."""

from __future__ import annotations

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from benchmarks.planting import of_cells, of_files, of_registrations, of_rows
from benchmarks.planting.world import World

SeenBy = Literal["files", "history", "second party"]


@dataclass(frozen=True)
class Kind:
    """A kind of change.

    Attributes:
        plant: Makes it.
        seen_by: Who sees every change of this kind, at least.
    """

    plant: Callable[[World], None]
    seen_by: SeenBy = "files"


def a_past_of_its_own(world: World) -> None:
    """Drives that were made up before anything was committed: the whole history is made up.

    Whoever has a clone of the true history sees it, or whoever drives again.
    """
    of_cells.stronger_drives(world)
    shutil.move(world.root / ".git", world.true_history)
    World(world.root, world.name, random.Random(0)).begin()


KINDS: dict[str, Kind] = {
    "a digit": Kind(of_files.a_digit),
    "a digit with its digest": Kind(of_files.a_digit_with_its_digest, "history"),
    "a number of the manifest": Kind(of_files.a_number_of_the_manifest),
    "what the set says it was deployed through": Kind(of_files.deployed_through),
    "the page of all sets": Kind(of_files.the_page),
    "a picture": Kind(of_files.a_picture),
    "a picture with its digest": Kind(of_files.a_picture_with_its_digest),
    "a film": Kind(of_files.a_film),
    "a film with its digest": Kind(of_files.a_film_with_its_digest, "history"),
    "the reference build": Kind(of_files.the_reference_build),
    "the reference build with its digest": Kind(of_files.the_reference_build_with_its_digest, "history"),
    "a file more": Kind(of_files.a_file_more),
    "a file less": Kind(of_files.a_file_less),
    "a given reason, renewed": Kind(of_files.a_given_reason, "history"),
    "a digest": Kind(of_files.a_digest),
    "a dropped drive, renewed": Kind(of_cells.a_dropped_drive),
    "a cell that was not registered, renewed": Kind(of_cells.a_strange_cell),
    "another victim, renewed": Kind(of_cells.another_victim),
    "another start, renewed": Kind(of_cells.another_start),
    "a leap, renewed": Kind(of_cells.a_leap),
    "wider poses, renewed": Kind(of_cells.wider_poses),
    "stronger drives of the attack, renewed": Kind(of_cells.stronger_drives, "history"),
    "a copied drive, renewed": Kind(of_cells.a_copied_drive),
    "swapped seeds, renewed": Kind(of_cells.swapped_seeds, "history"),
    "a shared attack, renewed": Kind(of_cells.a_shared_attack),
    "more evaluations, renewed": Kind(of_cells.more_evaluations),
    "another space, renewed": Kind(of_cells.another_space),
    "a cell from before its registration, renewed": Kind(of_cells.an_earlier_date),
    "a cell of another day, renewed": Kind(of_cells.a_later_date, "history"),
    "deployed through something else, renewed": Kind(of_cells.driven_elsewhere, "history"),
    "a victim that drives badly, renewed": Kind(of_cells.a_bad_victim),
    "a verdict of the gate, renewed": Kind(of_cells.a_verdict_of_the_gate, "history"),
    "a prediction, renewed": Kind(of_cells.a_prediction, "history"),
    "a prediction of other settings, renewed": Kind(of_cells.a_prediction_of_other_settings),
    "another limit, renewed": Kind(of_registrations.another_limit),
    "another limit everywhere, renewed": Kind(of_registrations.another_limit_everywhere, "history"),
    "a dropped scenario, renewed": Kind(of_registrations.a_dropped_scenario, "history"),
    "a dropped search, renewed": Kind(of_registrations.a_dropped_search, "history"),
    "an earlier registration, renewed": Kind(of_registrations.an_earlier_registration, "history"),
    "fewer tests, renewed": Kind(of_registrations.fewer_tests, "history"),
    "another rule of driving well, renewed": Kind(of_registrations.another_rule_of_driving_well, "history"),
    "a changed registration, committed": Kind(
        of_registrations.a_changed_registration_is_committed, "history"
    ),
    "a changed cell, committed": Kind(of_registrations.a_changed_cell_is_committed, "history"),
    "cells committed before their registration": Kind(
        of_registrations.cells_before_their_registration, "history"
    ),
    "a removed set, renewed": Kind(of_registrations.a_removed_set, "history"),
    "a missed row": Kind(of_rows.a_missed_row, "history"),
    "a missed row, committed": Kind(of_rows.a_missed_row_is_committed, "history"),
    "a verdict of a row": Kind(of_rows.a_verdict, "history"),
    "a value of kept drives": Kind(of_rows.a_kept_value),
    "a value that was measured once": Kind(of_rows.a_value, "history"),
    "a row without its page": Kind(of_rows.a_row_without_its_page),
    "a figure on a page": Kind(of_rows.a_figure_on_a_page),
    "a value as if measured again": Kind(of_rows.a_value_of_another_day, "second party"),
    "a past of its own": Kind(a_past_of_its_own, "second party"),
}
