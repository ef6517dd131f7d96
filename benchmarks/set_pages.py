"""Write the numbers, pictures and page of published sets again from what is kept: ``python -m benchmarks.set_pages [SET ...]``.

Registrations, cells and films stay as they are. With --page, only the page and the manifest of the files beside the sets are written:
after a change of `sets_about.json`. `advnerf experiment publish` does the same for one set whose run folder is on this machine.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from advnerf_core.report.evidence.publishing import write_numbers, write_page
from advnerf_core.report.evidence.verifying.layout import complete_sets

PUBLISHED = Path(__file__).resolve().parents[1] / "docs" / "results"


def main() -> None:
    parser = argparse.ArgumentParser(description=main.__doc__)
    parser.add_argument("sets", nargs="*", default=complete_sets(PUBLISHED))
    parser.add_argument("--page", action="store_true", help="only the page and the manifest beside the sets")
    given = parser.parse_args()
    for name in () if given.page else given.sets:
        print(write_numbers(PUBLISHED / name).relative_to(PUBLISHED))
    write_page(PUBLISHED)


if __name__ == "__main__":
    main()
