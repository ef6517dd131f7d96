"""What ``advnerf verify`` finds in a changed copy of the published results, by the files alone and by their history."""

from __future__ import annotations

from dataclasses import dataclass

from advnerf_core.documents import read_json
from advnerf_core.files import sha256_of
from advnerf_core.report.evidence.page import picture_of
from advnerf_core.report.evidence.verify import verify_beside, verify_set
from advnerf_core.report.evidence.verifying.history import verify_history
from advnerf_core.report.evidence.verifying.pictures import picture_problems
from benchmarks.kept_rows import row_problems
from benchmarks.page_numbers import count_numbers
from benchmarks.planting.world import World
from benchmarks.published_check import row_page_problems, target_problems


@dataclass(frozen=True)
class Found:
    """Problems that were found.

    Attributes:
        files: By the files alone.
        history: By their history in git.
    """

    files: tuple[str, ...]
    history: tuple[str, ...]

    def __bool__(self) -> bool:
        return bool(self.files or self.history)


def find(world: World, picture_sha256: str) -> Found:
    """Verify a copy: its set, what lies beside it, its rows and pages, and its history.

    Args:
        world: The copy.
        picture_sha256: Of the picture as it was published; only another one is drawn again, which takes a second.
    """
    problems = list(verify_set(world.folder).problems) if world.folder.exists() else []
    problems += verify_beside(world.published)
    picture = world.published / picture_of(world.name)
    if picture.exists() and sha256_of(picture) != picture_sha256 and not problems:
        problems += picture_problems(world.folder)
    rows = read_json(world.ledger)
    problems += row_problems(rows, world.again)
    problems += target_problems(rows)
    problems += row_page_problems(rows, world.ledger.with_suffix(".md"))
    problems += count_numbers(world.root / "docs", rows).problems
    seen = verify_history(world.published)
    assert not seen.not_checked, seen.not_checked
    return Found(tuple(problems), seen.problems)
