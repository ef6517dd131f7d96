"""A kernel that calls one of another file computes with that file as it is now."""

from __future__ import annotations

import importlib
import os
import pkgutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from numba.core.registry import CPUDispatcher

import advnerf_core
from advnerf_core.kernel_cache import sources_digest, use_own_folder

CALLED = "from numba import njit\n\n@njit(cache=True)\ndef number():\n    return {value}\n"
CALLER = "from numba import njit\nfrom pack.called import number\n\n@njit(cache=True)\ndef asked():\n    return number()\n"
ASK = "{before}from pack.caller import asked\nprint(asked())\n"
OWN = "from pathlib import Path\nfrom advnerf_core.kernel_cache import use_own_folder\nuse_own_folder(Path('pack'))\n"


def ask(folder: Path, value: int, before: str) -> int:
    """What a fresh process computes when the called kernel returns a value."""
    (folder / "pack" / "called.py").write_text(CALLED.format(value=value))
    environment = {key: text for key, text in os.environ.items() if key != "NUMBA_CACHE_DIR"}
    environment["PYTHONDONTWRITEBYTECODE"] = "1"  # byte code is as old as its source to the second
    environment["PYTHONPATH"] = os.pathsep.join([str(folder), str(Path(__file__).parents[2])])
    done = subprocess.run(
        [sys.executable, "-c", ASK.format(before=before)],
        cwd=folder,
        env=environment,
        check=True,
        stdout=subprocess.PIPE,
        text=True,
    )
    return int(done.stdout)


@pytest.fixture
def package(tmp_path: Path) -> Path:
    """A package of two kernels, one of which calls the other."""
    (tmp_path / "pack").mkdir()
    (tmp_path / "pack" / "__init__.py").write_text("")
    (tmp_path / "pack" / "caller.py").write_text(CALLER)
    return tmp_path


def test_a_changed_kernel_is_compiled_into_those_that_call_it(package: Path) -> None:
    # The hazard: numba alone goes on with the kernel of before.
    assert [ask(package, 1, ""), ask(package, 2, "")] == [1, 1]
    assert [ask(package, value, OWN) for value in (1, 2)] == [1, 2]


def test_folders_follow_the_sources_and_old_ones_go(package: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(package / "cache"))
    seen = []
    for value in range(6):
        (package / "pack" / "called.py").write_text(CALLED.format(value=value))
        seen.append(use_own_folder(package / "pack"))
        assert os.environ["NUMBA_CACHE_DIR"] == str(seen[-1])  # and children find the same
    assert len(set(seen)) == 6
    assert use_own_folder(package / "pack") == seen[-1]
    assert len(list((package / "cache").iterdir())) == 4
    assert seen[-1].is_dir()


def test_files_without_kernels_change_nothing(package: Path) -> None:
    (package / "pack" / "called.py").write_text(CALLED.format(value=1))
    before = sources_digest(package / "pack")
    (package / "pack" / "other.py").write_text("x = 1\n")
    assert sources_digest(package / "pack") == before
    (package / "pack" / "called.py").rename(package / "pack" / "renamed.py")
    assert sources_digest(package / "pack") != before


def test_the_kernels_of_this_package_use_it() -> None:
    code = "import numba, advnerf_core.render.march_kernels; print(numba.config.CACHE_DIR)"
    done = subprocess.run([sys.executable, "-c", code], check=True, stdout=subprocess.PIPE, text=True)
    assert Path(done.stdout.strip()).name.startswith("advnerf-")


def kernels() -> Iterator[tuple[str, CPUDispatcher]]:
    """All kernels of the package for the processor, by name."""
    for each in pkgutil.walk_packages(advnerf_core.__path__, "advnerf_core."):
        module = sys.modules.get(each.name)
        for name, value in vars(module).items() if module is not None else ():
            if isinstance(value, CPUDispatcher) and value.py_func.__module__ == each.name:
                yield f"{each.name}.{name}", value


def test_kernels_are_inlined_where_they_are_called() -> None:
    for name in ("fields.hash_grid", "objects.voxel.build", "render.soft_pose", "scene.baked", "scene.train"):
        importlib.import_module(f"advnerf_core.{name}")
    found = dict(kernels())
    assert len(found) > 60
    assert [name for name, kernel in found.items() if not kernel.targetoptions.get("forceinline")] == []


TRAIN = """
import hashlib
import advnerf_core
from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.scene.field import SceneFieldConfig
from advnerf_core.scene.train import TrainConfig, Trainer
from tests.support.colour_room import room_images
grid = HashGridConfig(levels=4, features=4, log2_entries=10, coarsest=8, finest=32)
trainer = Trainer(room_images(), SceneFieldConfig((-1.05, -1.05, -0.55), (1.05, 1.05, 0.55), grid), TrainConfig(steps=4))
for _ in range(4):
    trainer.train_step()
state = trainer.stepper.state()
print(hashlib.sha256(b"".join(state[name].tobytes() for name in sorted(state))).hexdigest())
"""


@pytest.mark.slow
def test_a_process_that_compiles_computes_what_later_ones_do(tmp_path: Path) -> None:
    root = str(Path(__file__).parents[2])
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": root}
    seen = [
        subprocess.run(
            [sys.executable, "-c", TRAIN], env=environment, check=True, stdout=subprocess.PIPE
        ).stdout
        for _ in range(2)
    ]
    assert seen[0] == seen[1]
