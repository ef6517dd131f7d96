"""The site of the documentation is whole: every page, every link, a search index, and nothing from the network."""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.live.page_browser import available

ROOT = Path(__file__).parents[1]


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("mkdocs")
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--quiet", "--site-dir", str(folder)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 0, (
        done.stderr
    )  # strict: a broken link or a page missing from the navigation fails
    return folder


def test_every_page_is_in_the_site_and_in_its_navigation(site):
    pages = [*(ROOT / "docs").glob("*.md"), *(ROOT / "docs" / "results").glob("*.md")]
    home = (site / "index.html").read_text()
    assert len(pages) > 35
    for page in pages:
        name = page.relative_to(ROOT / "docs").with_suffix(".html")
        assert (site / name).is_file()
    assert {"attacks.html", "results.html", "api.html"} <= set(re.findall(r'href="([\w.]+)"', home))


def test_links_to_source_files_lead_to_copies_of_them(site):
    page = (site / "worlds.html").read_text()
    assert 'href="source/hardware/worlds/world.py"' in page
    copy = site / "source" / "hardware" / "worlds" / "world.py"
    assert copy.read_bytes() == (ROOT / "hardware" / "worlds" / "world.py").read_bytes()


def test_nothing_is_loaded_from_elsewhere(site):
    for page in site.rglob("*.html"):
        loaded = re.findall(r'<(?:script|link|img)[^>]+(?:src|href)="(https?:[^"]+)"', page.read_text())
        assert [address for address in loaded if "canonical" not in address] == []


def test_the_search_finds_what_a_page_says(site):
    index = json.loads((site / "search" / "search_index.json").read_text())
    assert any("stall" in entry["text"] and entry["location"].startswith("faults") for entry in index["docs"])


@pytest.mark.browser
@pytest.mark.skipif(not available(), reason="needs playwright and /usr/bin/chromium")
@pytest.mark.parametrize("page", ["index.html", "results/room.html"])
def test_the_search_works_in_pages_opened_as_files(site, page, browser):
    tab = browser.new_context(offline=True).new_page()
    tab.goto((site / page).as_uri())
    tab.fill("input.md-search__input", "stall")
    found = tab.wait_for_selector("a.md-search-result__link", state="attached").get_attribute("href")
    assert found.startswith(f"{site.as_uri()}/")
