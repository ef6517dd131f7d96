"""Whether the published numbers of a set agree with its drives."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.contrasts import contrast_data
from advnerf_core.report.evidence.place_claims import place_claim_data
from advnerf_core.report.evidence.results import Evidence, as_data
from advnerf_core.report.evidence.verifying.layout import FORMAT, SET
from advnerf_core.report.evidence.verifying.victims import declared_data

_TABLES = ("rows", "primary", "contrasts", "claims", "does_not_drive_well")


def published_numbers(
    evidence: Evidence, withdrawn: Mapping[str, str], declared: Mapping[str, str]
) -> dict[str, Any]:
    """All numbers of a set as JSON data, with its declarations."""
    return {
        "format": FORMAT,
        "name": evidence.registration.name,
        "registration": evidence.registration.digest,
        **({"withdrawn": dict(withdrawn)} if withdrawn else {}),
        **declared_data(evidence, declared),
        **as_data(evidence),
        **contrast_data(evidence),
        **place_claim_data(evidence),
    }


def number_problems(folder: Path, expected: Mapping[str, Any]) -> tuple[int, list[str]]:
    """Count of published numbers, and those that disagree with the expected ones from `published_numbers`."""
    published, found = read_json(folder / SET), json.loads(json.dumps(expected))
    count, wrong = 0, []
    for key in sorted((published.keys() | found.keys()) - {"files", *_TABLES}):
        if not same(published.get(key), found.get(key)):
            wrong.append(f"{SET}, {key}: published {published.get(key)!r}, computed {found.get(key)!r}")
    for part in _TABLES:
        there, again = published.get(part, []), found.get(part, [])
        if len(there) != len(again):
            wrong.append(f"{SET}, {part}: expected {len(again)}, got {len(there)}")
        for said, row in zip(there, again, strict=False):
            count += len(row)
            wrong += [
                f"{SET}, {part}, {name}: published {said.get(name)!r}, computed {row.get(name)!r}"
                for name in sorted(said.keys() | row.keys())
                if not same(said.get(name), row.get(name))
            ]
    return count, wrong


def same(said: Any, again: Any) -> bool:
    """Whether two JSON values are equal; numbers may differ in the last bits between machines."""
    if isinstance(said, float) and isinstance(again, float):
        return bool(np.isclose(said, again, rtol=1e-9, atol=1e-12))
    if isinstance(said, dict) and isinstance(again, dict):
        return said.keys() == again.keys() and all(same(said[key], again[key]) for key in said)
    if isinstance(said, list) and isinstance(again, list):
        return len(said) == len(again) and all(map(same, said, again))
    return bool(said == again)
