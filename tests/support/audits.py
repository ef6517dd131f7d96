"""Results of audits for tests, as an audit would write them."""

from advnerf_core.report.audit_result import AuditResult

SHA = "0123456789abcdef" * 4


def judged_starts(effects_m, control_m=0.1, off_track_m=0.5):
    return [
        {
            "x_m": 0.01 * i,
            "y_m": -0.02 * i,
            "yaw_rad": 0.001 * i,
            "off_path_m": control_m + effect_m,
            "control_off_path_m": control_m,
            "off_track": control_m + effect_m > off_track_m,
            "control_off_track": control_m > off_track_m,
        }
        for i, effect_m in enumerate(effects_m)
    ]


def judged_drives(evidence="world", effects_m=(0.8, 0.9, 1.0, 0.3)):
    mean_m = sum(effects_m) / len(effects_m)
    route = [{"t_s": 0.1 * i, "x_m": 0.2 * i, "y_m": 0.01 * i * i, "yaw_rad": 0.1 * i} for i in range(8)]
    return {
        "evidence": evidence,
        "measure": "max_abs_cte",
        "control": "plain_object",
        "effect": {"mean_m": mean_m, "low_m": mean_m - 0.1, "high_m": mean_m + 0.15},
        "starts": judged_starts(effects_m),
        "path": [{**point, "y_m": 0.0, "yaw_rad": 0.0} for point in route],
        "route": route,
    }


def comparison(outcome):
    """The comparison of a result with this outcome to an earlier one."""
    return {
        "file": "old.json",
        "sha256": "0" * 64,
        "effect": judged_drives()["effect"],
        "margin_m": 0.05 if outcome == "worse" else 5.0,
        "starts": 4,
    }


def audit(outcome="found", evidence="world", **changes):
    """A valid result of an audit as JSON values; ``changes`` replace whole sections."""
    reasons = (
        ["the policy does not drive: it left its lane in 3 of 4 starts"] if outcome == "cannot_judge" else []
    )
    panel = {
        "name": "panel at the second bend",
        "kind": "panel",
        "size_m": [0.02, 0.6, 0.6],
        "pose": {"x_m": 3.0, "y_m": 0.8, "z_m": 0.0, "yaw_rad": 3.1},
        "texture": "panel.png",
        "texture_sha256": SHA,
    }
    starts = {
        name: {"seed": seed, "count": 4} for seed, name in enumerate(("search", "selection", "judging"))
    }
    return {
        "format": "advnerf-audit-1",
        "verdict": {
            "outcome": outcome,
            "evidence": None if outcome == "cannot_judge" else evidence,
            "sentence": "In MetaDrive, a 0.6 m panel at the second bend moves it 0.75 m off its path (95 % 0.65 to 0.90).",
            "reasons": reasons,
        },
        "policy": {"path": "policies/my_policy.onnx", "sha256": SHA},
        "place": {
            "name": "MetaDrive",
            "kind": "world",
            "source": "metadrive",
            "scale": "world",
            "off_track_m": 0.5,
        },
        "vehicle": {"name": "roboracer", "wheelbase_m": 0.33, "speed_mps": 2.0},
        "strongest": {"object": panel, "judgements": [judged_drives(evidence)]},
        "controls": [
            {
                "kind": "no_object",
                "name": "no object",
                "evidence": evidence,
                "mean_off_path_m": 0.1,
                "off_track": 0,
                "starts": 4,
            },
            {
                "kind": "plain_object",
                "name": "grey panel",
                "evidence": evidence,
                "mean_off_path_m": 0.1,
                "off_track": 0,
                "starts": 4,
            },
        ],
        "planted": {"name": "known victim", "found": True, "evaluations": 40, "effect_m": 0.9},
        "tried": [
            {
                "object": "panel",
                "placement": "largest_view",
                "space": "colours",
                "method": "gradient",
                "evaluations": 50,
                "effect_m": 0.7,
                "selected": True,
            }
        ],
        "not_tried": [{"what": "mesh objects", "why": "the budget ended"}],
        "fidelity": {"views": 20, "psnr_db": 27.1, "steering_difference": 0.01, "trusted": True},
        "starts": starts,
        "budget": {
            "evaluations_planned": 120,
            "evaluations_spent": 90,
            "seconds": 610.0,
            "ended": "schedule",
        },
        "question": {"file": "audit.experiment.yaml", "sha256": SHA},
        "versions": {"advnerf": "0.1.0"},
        "date": "2026-11-25T18:30:00+00:00",
        **changes,
    }


def audit_result(outcome="found", evidence="world", **changes) -> AuditResult:
    return AuditResult.model_validate(audit(outcome, evidence, **changes))
