"""Files of a cell's search in its folder, and the precision of stored attacks."""

from __future__ import annotations

from advnerf_core.report.cells import CellResult

FROZEN, SEARCHED, ATTACK = "frozen.json", "surrogate.json", "attack.safetensors"
# A cell's note that its texture was rounded to half precision before it was driven past.
THETA = "float16"


def is_published_with_its_attack(cell: CellResult) -> bool:
    """Whether a cell's attack must be published with it; cells from before textures were rounded have none."""
    return cell.attack_id is not None and cell.extra.get("theta") == THETA
