"""Most benchmarks run by hand and seldom: one that a changed name has broken is noticed here."""

import importlib
import pkgutil

import pytest

import benchmarks

_OURS = ("advnerf_core", "benchmarks", "calibration", "hardware", "nodes")


@pytest.mark.parametrize("name", [module.name for module in pkgutil.iter_modules(benchmarks.__path__)])
def test_every_benchmark_imports(name):
    try:
        importlib.import_module(f"benchmarks.{name}")
    except ModuleNotFoundError as missing:
        package = (missing.name or "").partition(".")[0]
        if package in _OURS:
            raise
        pytest.skip(f"needs {package}, which is not installed")
