"""Holds the Python of the pages against the types of the code: ``python docs/check_code.py``, part of ``make check``.

A block goes through mypy as it stands. Names that an earlier paragraph explains may be undefined, and ``...`` may stand for what
the reader has; a module, attribute or argument that does not exist is an error, named by page and line.
"""

from __future__ import annotations

import re
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).parents[1]
_BLOCK = re.compile(r"^```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)
# pyproject.toml says what is allowed in this package. Options on the command line would make mypy look at all code again.
_PACKAGE = "blocks_of_pages"


def blocks(text: str) -> dict[int, str]:
    """The Python blocks of a page by the number of their first line."""
    return {text[: found.start()].count("\n") + 2: found[1] for found in _BLOCK.finditer(text)}


def faults(pages: dict[str, str]) -> list[str]:
    """What mypy says of the blocks of some pages (name and text), as ``page:line: error``."""
    with tempfile.TemporaryDirectory(prefix="advnerf-pages-") as folder:
        names, package = {}, Path(folder) / _PACKAGE
        package.mkdir()
        (package / "__init__.py").touch()
        for number, (page, text) in enumerate(pages.items()):
            for line, code in blocks(text).items():
                # A name of this run: of a module that mypy has in its cache it would say nothing again.
                file = package / f"page{number}_line{line}_{Path(folder).name[-8:]}.py"
                file.write_text(
                    "\n" * (line - 1) + code, encoding="utf-8"
                )  # so that mypy counts lines as the page does
                names[str(file)] = page
        if not names:
            return []
        command = [sys.executable, "-m", "mypy", "--no-error-summary", *names]
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.stderr:
        return [done.stderr.strip()]
    found = (re.match(r"(.*?\.py)(:\d+: error: .*)", line) for line in done.stdout.splitlines())
    # Faults of the code itself are the concern of mypy's own run.
    return [names[each[1]] + each[2] for each in found if each and each[1] in names]


def main() -> None:
    """Check every page except the generated one; exit 1 if a block is wrong."""
    files = [ROOT / "README.md", ROOT / "examples" / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
    pages = {
        str(file.relative_to(ROOT)): file.read_text(encoding="utf-8")
        for file in files
        if file.name != "api.md"
    }
    found = faults(pages)
    print(
        "\n".join(found)
        if found
        else f"{sum(len(blocks(text)) for text in pages.values())} Python blocks fit the code"
    )
    sys.exit(bool(found))


if __name__ == "__main__":
    main()
