"""The pictures of the architecture page are those of the code; ``make rooms`` draws them again."""

from graphlib import CycleError, TopologicalSorter
from pathlib import Path

import grimp
import pytest

from docs import draw_rooms

ROOT = Path(__file__).parents[1]


def test_the_architecture_page_is_drawn_from_the_code():
    stale = [
        file.name for file, text in draw_rooms.written().items() if file.read_text(encoding="utf-8") != text
    ]
    assert stale == [], "run `make rooms`"


def test_floors_put_every_room_above_what_it_imports():
    arrows = {
        "roof": frozenset({"a", "b", "base"}),
        "a": frozenset({"b"}),
        "b": frozenset({"base"}),
        "base": frozenset(),
    }
    assert draw_rooms.floors(arrows) == [["roof"], ["a"], ["b"], ["base"]]
    assert draw_rooms.reduced(arrows) == {"roof": {"a"}, "a": {"b"}, "b": {"base"}, "base": set()}
    with pytest.raises(ValueError, match="circle of imports, got a -> b -> a"):
        draw_rooms.floors({"a": frozenset({"b"}), "b": frozenset({"a"})})


def test_no_module_imports_itself_in_a_circle_not_even_for_types():
    graph = grimp.build_graph(*draw_rooms.PACKAGES, cache_dir=None)
    imports = {module: graph.find_modules_directly_imported_by(module) for module in graph.modules}
    assert sum(map(len, imports.values())) > len(imports), "there are imports at all"
    try:
        TopologicalSorter(imports).prepare()
    except CycleError as error:
        pytest.fail(f"circle of imports: {' -> '.join(error.args[1])}")


def test_the_top_of_nodes_holds_processes_only():
    files = [file for file in (ROOT / "nodes").glob("*.py") if file.name != "__init__.py"]
    assert len(files) == 20
    runs = 'if __name__ == "__main__":'
    assert [file.name for file in files if runs not in file.read_text(encoding="utf-8")] == []
