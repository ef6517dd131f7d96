"""The tests of what runs on a GPU, in numba's simulator: the same source, line by line, on a machine without a device."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]


@pytest.mark.parametrize(
    ("file", "least"),
    [
        pytest.param("scene/test_device_surrogate.py", 11, id="pictures", marks=pytest.mark.slow),
        pytest.param("attack/test_on_device.py", 5, id="searches", marks=pytest.mark.slow),
    ],
)
def test_the_code_for_a_gpu_computes_in_the_simulator_what_the_processor_does(file: str, least: int) -> None:
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-m", "gpu", str(TESTS / file)]
    done = subprocess.run(
        command,
        env={**os.environ, "NUMBA_ENABLE_CUDASIM": "1", "CUDA_VISIBLE_DEVICES": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        timeout=600,
    )
    assert done.returncode == 0, done.stdout
    assert int(re.search(r"(\d+) passed", done.stdout)[1]) >= least, done.stdout
    assert "skipped" not in done.stdout
