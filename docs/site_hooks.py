"""Hooks of MkDocs: README and the examples become pages, and a linked source file comes along, so that the site is whole offline."""

from __future__ import annotations

import os
import re
from pathlib import Path, PurePosixPath

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page

ROOT = Path(__file__).parents[1]
PAGES = {"index.md": "README.md", "examples.md": "examples/README.md"}
"""Pages that live outside ``docs/``: name in the site, and file of the repository."""
_LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)#\s]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages of `PAGES` and every file outside ``docs/`` that a page links to."""
    for name, source in PAGES.items():
        files.append(File.generated(config, name, content=(ROOT / source).read_text(encoding="utf-8")))
    for page in [file for file in files if file.src_uri.endswith(".md")]:
        for target in map(_outside, _targets(page.src_uri, page.content_string)):
            if target and files.get_file_from_path(f"source/{target}") is None:
                files.append(File.generated(config, f"source/{target}", abs_src_path=str(ROOT / target)))
    return files


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Point the links of a page at where their files lie in the site."""
    home = page.file.src_uri
    return _LINK.sub(lambda link: _in_site(home, link), markdown)


def _targets(home: str, text: str) -> list[str]:
    """Files of the repository that a page links to."""
    return [_of_repository(home, link[3]) for link in _LINK.finditer(text) if "://" not in link[3]]


def _of_repository(home: str, link: str) -> str:
    """The file, relative to the root, that ``link`` of the page ``home`` means."""
    folder = PurePosixPath(PAGES.get(home, f"docs/{home}")).parent
    return (ROOT / folder / link).resolve().relative_to(ROOT).as_posix()


def _outside(target: str) -> str:
    """``target`` if it is a file that is not part of the site anyway, else nothing."""
    if not (ROOT / target).is_file() or target in PAGES.values():
        return ""
    ours = target.startswith("docs/") and target.endswith((".md", ".png", ".jpg", ".svg", ".webp"))
    return "" if ours else target


def _in_site(home: str, link: re.Match[str]) -> str:
    mark, text, target, anchor = link[1], link[2], link[3], link[4] or ""
    if "://" in target:
        return link[0]
    file = _of_repository(home, target)
    if not (ROOT / file).is_file():  # a folder: there is no page to go to
        return f"{text} (`{file}/`)"
    pages = {source: name for name, source in PAGES.items()}
    where = f"source/{file}" if _outside(file) else pages.get(file, file.removeprefix("docs/"))
    return f"{mark}[{text}]({os.path.relpath(where, PurePosixPath(home).parent)}{anchor})"
