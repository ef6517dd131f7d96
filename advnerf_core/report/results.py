"""`results.json`: all numbers of a report, and the same records read back."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

from pydantic import TypeAdapter, ValidationError

from advnerf_core.documents import read_json
from advnerf_core.errors import ConfigError
from advnerf_core.report.data import ReportData
from advnerf_core.report.tables import transfer_rows
from advnerf_core.report.targets import evaluate_targets

SCHEMA = "advnerf-results/1"
_ADAPTER: TypeAdapter[ReportData] = TypeAdapter(ReportData)


def results_dict(data: ReportData) -> dict[str, Any]:
    """The report as JSON-ready values: the derived tables first, then every record (images left out)."""
    return {
        "schema": SCHEMA,
        "targets": [t.record() for t in evaluate_targets(data)],
        "transfer": [r.record() for r in transfer_rows(data)],
        "data": _ADAPTER.dump_python(data, mode="json"),
    }


def write_results(data: ReportData, path: Path) -> Path:
    """Write `results.json` atomically."""
    write_text_atomic(
        path, json.dumps(results_dict(data), indent=1, allow_nan=False, ensure_ascii=False) + "\n"
    )
    return path


def read_results(path: Path) -> ReportData:
    """Read the records of a `results.json`; images come back as None."""
    try:
        content = read_json(path)
    except ConfigError as e:
        raise ValueError(f"expected JSON in {path}, got: {e}; run the report stage again") from e
    schema = content.get("schema") if isinstance(content, dict) else None
    if schema != SCHEMA:
        raise ValueError(f"expected schema {SCHEMA!r} in {path}, got {schema!r}; run the report stage again")
    try:
        return _ADAPTER.validate_python(content["data"])
    except (KeyError, ValidationError) as e:
        raise ValueError(
            f"expected the records of a report in {path}, got: {e}; run the report stage again"
        ) from e


def write_text_atomic(path: Path, text: str) -> None:
    """Write a whole text file, or leave the old one as it was."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.write_text(text, encoding="utf-8")
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
