"""Compares a policy with an earlier audit: it drives from the same starts past nothing, the plain object, and the object found then."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.attack.artifact import load_attack
from advnerf_core.files import sha256_of
from advnerf_core.geometry import wrap_angle
from advnerf_core.report.audit_result import AuditComparison, AuditedObject, AuditResult, Evidence, read_audit
from nodes.audit.drives import NO_OBJECT
from nodes.audit.judging import comparison_of
from nodes.audit.kept import read_drives
from nodes.audit.verdict import ArmDrives
from nodes.experiment.plan.object_kinds import footprint_m, name_of
from nodes.runtime.errors import ConfigError

ATTACK_KEPT = "object.attack.safetensors"
# A change of the largest deviation up to this share of half a lane is no regression.
MARGIN = 0.1
# How accurately a world puts its car down.
_SAME_START_M, _SAME_START_RAD = 0.05, 0.1


class Before:
    """An earlier audit, with its drives and its object, from its ``audit.json``.

    Raises:
        ConfigError: It judged no object, or its folder lacks the drives or the attack.
    """

    def __init__(self, file: Path) -> None:
        self.file, self.folder = file, file.parent
        self.result: AuditResult = read_audit(file)
        if self.result.strongest is None:
            raise ConfigError(
                f"--against {file}: expected an audit that judged an object, got {self.result.verdict.outcome}"
            )
        for name in ("drives.json", ATTACK_KEPT):
            if not (self.folder / name).is_file():
                raise ConfigError(
                    f"--against {file}: expected {name} beside it, as advnerf audit leaves it, which is not there"
                )
        load_attack(self.folder / ATTACK_KEPT)
        self.object: AuditedObject = self.result.strongest.object

    def listed(self, kind: str) -> dict[str, Any]:
        """The object in the form of experiment files, if it is of the current kind.

        Raises:
            ConfigError: The object is of another kind.
        """
        then = self.object
        if name_of(kind) != then.kind:
            raise ConfigError(
                f"--against {self.file}: expected --object {then.kind} as then, got {name_of(kind)}"
            )
        pose = {key: getattr(then.pose, key) for key in ("x_m", "y_m", "z_m", "yaw_rad")}
        return {
            "name": then.name,
            "kind": kind,
            **pose,
            "scale": round(then.size_m[1] / footprint_m(kind)[1], 9),
        }

    def compare(self, now: Mapping[str, ArmDrives], evidence: Evidence, limit_m: float) -> AuditComparison:
        """The change of the arm that got worst, from drives of all arms from the earlier starts; the lane ends at a |CTE| of ``limit_m`` [m].

        Raises:
            ConfigError: The earlier audit judged by other evidence, or from other starts, as of another place.
        """
        kept = read_drives(self.folder).get(evidence)
        if kept is None:
            raise ConfigError(
                f"--against {self.file}: expected drives of the same kind as now, {evidence}, got none; compare audits of one place"
            )
        then = kept.arms
        self._require_same_starts(now[NO_OBJECT], then[NO_OBJECT])
        return AuditComparison(
            file=str(self.file),
            sha256=sha256_of(self.file),
            margin_m=MARGIN * limit_m,
            starts=self.result.starts.judging.count,
            **comparison_of(now, then, limit_m),
        )

    def _require_same_starts(self, now: ArmDrives, then: ArmDrives) -> None:
        """Refuse drives that do not begin where the earlier ones did: of another place, path or lane, of which the seed draws others."""
        starts, before = now.states[:, 0, :3], then.states[:, 0, :3]
        if starts.shape == before.shape:
            off_m = float(np.hypot(*(starts - before)[:, :2].T).max())
            turned_rad = float(np.abs(wrap_angle(starts[:, 2] - before[:, 2])).max())
            if off_m <= _SAME_START_M and turned_rad <= _SAME_START_RAD:
                return
            got = f"others, up to {off_m:.3f} m and {turned_rad:.3f} rad from them"
        else:
            got = f"{len(starts)} instead of {len(before)}"
        raise ConfigError(
            f"--against {self.file}: expected the starts of that audit, got {got}; compare audits of one place, path, car and --limit"
        )
