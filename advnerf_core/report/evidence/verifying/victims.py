"""The registered rule of driving well, and the victims of a set that fail it."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.files import write_json
from advnerf_core.report.conditions import NONE
from advnerf_core.report.evidence.registration import (
    SetError,
    read_reasons,
    require_registration,
)
from advnerf_core.report.evidence.results import Evidence
from advnerf_core.report.reference import DOMAINS

# In the folder of a set: victims that fail the rule, each with its authors' explanation.
DECLARED = "set/does_not_drive_well.json"


def drives_badly(evidence: Evidence) -> list[dict[str, Any]]:
    """Victims whose drives without attack break the registered rule, as JSON data: a mean |CTE| above the limit, or a drive off the track."""
    found = []
    for cell in evidence.cells.values():
        if cell.method != NONE or not evidence.is_registered(cell):
            continue
        limit_m = evidence.scenario_of(cell).drives_well_mean_cte_m
        for domain in DOMAINS:
            drives = evidence.metrics(cell, domain)
            if not drives:
                continue
            mean_m, off = (
                float(np.mean([each.mean_cte_m for each in drives])),
                sum(d.off_track for d in drives),
            )
            if mean_m > limit_m or off:
                where = {"scenario": cell.scenario, "victim": cell.victim}
                found.append(
                    {**where, "domain": domain, "mean_cte_m": mean_m, "limit_m": limit_m, "off_track": off}
                )
    return found  # fmt: skip


def victim_key(row: Mapping[str, Any]) -> str:
    """Name of a victim in a declaration, ``SCENARIO.VICTIM``."""
    return f"{row['scenario']}.{row['victim']}"


def read_declared(folder: Path) -> dict[str, str]:
    """Victims of a set that are declared not to drive well, each with the reason for showing them; empty without any.

    Raises:
        SetError: The file is invalid.
    """
    return read_reasons(folder / DECLARED, "victims")


def declare(folder: Path, victims: Mapping[str, str]) -> None:
    """Declare that victims do not drive well, with the reason for showing them.

    Raises:
        SetError: A victim was not registered, or has no reason.
    """
    known = dict.fromkeys(victim_key(vars(cell)) for cell in require_registration(folder).cells)
    for victim, reason in victims.items():
        if victim not in known:
            raise SetError(f"expected a registered victim ({', '.join(known)}) to declare, got {victim!r}")
        if not reason.strip():
            raise SetError(f"expected a reason for showing {victim}; give {victim}=REASON")
    write_json(folder / DECLARED, {**read_declared(folder), **victims})


def declaration_problems(evidence: Evidence, declared: Mapping[str, str]) -> Iterator[str]:
    """Whether exactly the victims that break the rule are declared."""
    badly = {victim_key(row): row for row in drives_badly(evidence)}
    for victim, row in badly.items():
        if victim not in declared:
            yield (
                f"{victim}: does not drive well: mean |CTE| {row['mean_cte_m']:.4f} m {row['domain']} without attack, at most {row['limit_m']:.4f} m "
                f"was registered, {row['off_track']} drives off the track; publish with --declare {victim}=REASON"
            )
    yield from (
        f"{victim}: is declared not to drive well, and does" for victim in declared if victim not in badly
    )


def declared_data(evidence: Evidence, declared: Mapping[str, str]) -> dict[str, Any]:
    """The entry about such victims in ``set.json`` and on the page; empty without any."""
    rows = [{**row, "reason": declared.get(victim_key(row), "")} for row in drives_badly(evidence)]
    return {"does_not_drive_well": rows} if rows else {}
