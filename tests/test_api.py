"""The public names: each can be imported and is described, the page is that of the code, and asking for none of them loads nothing."""

import ast
import importlib
import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from docs import write_api

ROOT = Path(__file__).parents[1]
HEAVY = ("torch", "scipy", "numpy", "cv2", "zmq", "pydantic", "rosbags", "mcap", "mujoco", "matplotlib")


def in_a_fresh_process(statement, *others):
    """Which of the heavy modules are loaded after a statement, and how long it took [s]."""
    code = f"""
        import json, sys, time
        began = time.perf_counter()
        {statement}
        taken = time.perf_counter() - began
        print(json.dumps([[name for name in {HEAVY!r} if name in sys.modules], taken]))
    """
    code = "\n".join(line.strip() for line in code.strip().splitlines())
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    command = [sys.executable, *others, "-c", code]
    done = subprocess.run(command, capture_output=True, text=True, cwd=ROOT, env=environment, timeout=600)
    assert done.returncode == 0, done.stderr
    loaded, taken = json.loads(done.stdout)
    return set(loaded), taken


@pytest.mark.parametrize("package", write_api.PACKAGES)
def test_a_package_loads_nothing_but_itself(package):
    assert in_a_fresh_process(f"import {package}")[0] == set()


@pytest.mark.timing
@pytest.mark.parametrize("package", write_api.PACKAGES)
def test_a_package_loads_within_50_ms(package):
    assert min(in_a_fresh_process(f"import {package}")[1] for _ in range(3)) < 0.05


@pytest.mark.parametrize(
    "statement",
    [
        "import advnerf_core.geometry",
        "from advnerf_core import AdvnerfError, AttackFile, Path, Pinhole, PolicyContract, PolicyView, load_attack",
        "from advnerf_core import load_any_policy, load_transforms",
        "from nodes.runtime import Bus, Node, run_node_main",
        "from nodes.bags import BagWriter, read_messages",
        "from hardware.worlds import World",
    ],
)
def test_what_needs_no_torch_loads_none(statement):
    loaded, _ = in_a_fresh_process(statement)
    assert "numpy" in loaded
    assert not loaded & {"torch", "scipy", "mujoco", "matplotlib"}


@pytest.mark.parametrize("package", write_api.PACKAGES)
def test_every_public_name_is_the_one_its_module_defines(package):
    module = importlib.import_module(package)
    entries = write_api.entries(package)
    assert sorted(module.__all__) == sorted(entry.name for entry in entries) == dir(module)
    for entry in entries:
        home = importlib.import_module(entry.module)
        assert getattr(module, entry.name) is getattr(home, entry.name)
        assert getattr(getattr(home, entry.name), "__module__", entry.module) == entry.module, (
            "import it from its home"
        )


def test_a_name_that_is_not_public_is_an_attribute_error_that_python_completes():
    package = importlib.import_module("advnerf_core")
    with pytest.raises(AttributeError, match="module 'advnerf_core' has no attribute 'Pth'") as raised:
        package.Pth  # noqa: B018 - asked for on purpose
    assert (raised.value.name, raised.value.obj) == ("Pth", package)
    with pytest.raises(ImportError, match="cannot import name 'Pth'"):
        from advnerf_core import Pth  # noqa: F401
    # Modules that share a package with public names are still found.
    from nodes.bags import repair

    assert repair.__name__ == "nodes.bags.repair"


@pytest.mark.slow
def test_a_type_checker_knows_the_types_of_public_names_and_no_others(tmp_path):
    (tmp_path / "mine.py").write_text(
        "from advnerf_core import Pth, load_attack\nfrom nodes.bags import read_info\n"
        "reveal_type(load_attack)\nreveal_type(read_info)\n"
    )
    environment = {**os.environ, "MYPYPATH": str(ROOT)}
    command = [
        sys.executable,
        "-m",
        "mypy",
        "--strict",
        "--config-file",
        str(ROOT / "pyproject.toml"),
        "mine.py",
    ]
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=600)
    assert 'mine.py:1: error: Module "advnerf_core" has no attribute "Pth"' in done.stdout
    assert '-> advnerf_core.attack.artifact.AttackFile"' in done.stdout
    assert '(bag: pathlib.Path) -> nodes.bags.info.BagInfo"' in done.stdout


def test_public_names_can_be_looked_up_again_and_stay_the_same():
    package = importlib.import_module("advnerf_core")
    assert package.Pinhole is package.Pinhole
    assert "Pinhole" in vars(package)


@pytest.mark.parametrize("package", write_api.PACKAGES)
def test_docstrings_give_shapes_and_units(package):
    assert write_api.gaps(package) == []


@pytest.mark.parametrize(
    ("source", "gap"),
    [
        (
            'def f(theta: Tensor) -> None:\n    """Do it."""',
            "expected the shape of theta (Tensor), found none",
        ),
        ('def f() -> Array:\n    """A pose."""', "expected the shape of what it returns (Array), found none"),
        (
            'def f(a: Tensor, b: int) -> None:\n    """Do it to ``[3]``.\n\n    Args:\n        b: Count.\n    """',
            "expected a description of a, found none",
        ),
        (
            'def f(width_m: float) -> None:\n    """Do it.\n\n    Args:\n        width_m: Width.\n    """',
            "expected the unit [m] of width_m, found none",
        ),
        (
            'def f(width_m: float) -> None:\n    """Do it.\n\n    Args:\n        width_m: Width [px].\n    """',
            "expected the unit [m] of width_m, found none",
        ),
        ('class C:\n    """It."""\n    def f(self) -> None:\n        pass', "f has no docstring"),
        ('@dataclass\nclass C:\n    """It."""\n    x_m: float', "expected a description of x_m, found none"),
        ('def f(a: Tensor) -> Tensor:\n    """Colours ``[B, 3]`` of ``a``."""', None),
        ('def f(a: Callable[[Tensor], Tensor]) -> None:\n    """Call it."""', None),
    ],
)
def test_what_a_docstring_lacks_is_found(source, gap):
    node = ast.parse(source).body[0]
    find = (
        write_api._class_gaps
        if isinstance(node, ast.ClassDef)
        else lambda each: write_api._function_gaps(each, "")
    )
    assert list(find(node)) == ([] if gap is None else [gap])


def test_the_page_is_written_from_the_code():
    assert write_api.PAGE.read_text(encoding="utf-8") == write_api.written(), "run `make api`"


def test_the_page_shows_types_defaults_shapes_and_methods():
    text = write_api.PAGE.read_text(encoding="utf-8")
    assert "cube_face_object(\n    size_m: float = 0.8,\n    resolution: int = 16," in text
    assert "- `start_states: Tensor`: `[B, n]`; states and lambdas have their dtype." in text
    assert "- `held_cap_m: float = 1.5`: Cap of the |CTE|" in text
    assert "- **`project(xy_m: ArrayLike) -> Projection`**: Nearest point" in text
    assert "- **`Path.from_segments(start_pose: tuple[float, float, float]" in text
    for package in write_api.PACKAGES:
        for entry in write_api.entries(package):
            assert text.count(f'### <a id="{entry.anchor}"></a>') == text.count(f"](#{entry.anchor})") == 1
