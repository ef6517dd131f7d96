"""Puts what a checkout has beside its packages into the wheel too. Everything else about the package is in pyproject.toml."""

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

# `nodes.runtime.paths.shipped` finds them in both.
SHIPPED = ("launch", "examples", "docs/results/reference")


class BuildWithShippedFiles(build_py):
    """Copies the folders of `SHIPPED` into nodes/shipped."""

    def run(self) -> None:
        """Build, then copy; an editable installation has the checkout."""
        super().run()
        if self.editable_mode:
            return
        for name in SHIPPED:
            target = Path(self.build_lib, "nodes", "shipped", name)
            shutil.rmtree(target, ignore_errors=True)  # of a build before this one
            shutil.copytree(name, target, ignore=shutil.ignore_patterns("__pycache__", "*.pyc", ".*"))


setup(cmdclass={"build_py": BuildWithShippedFiles})
