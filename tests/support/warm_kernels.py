"""Compile the kernels that tests need: ``python -m tests.support.warm_kernels``. The tiny experiment needs most of them."""

import tempfile
from pathlib import Path

from tests.support.stage_versions import measured

if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        measured(Path(folder) / "run")
