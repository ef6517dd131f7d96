import subprocess
import sys

CODE = """
import numpy as np
from advnerf_core.memory import peak_mib, restart_peak
idle = restart_peak()
held = np.ones(64 * 2**17)          # 64 MiB of float64, written
grown = peak_mib() - idle
del held
again = restart_peak()
print(grown, peak_mib() - again)
"""


def test_the_peak_follows_what_is_held_and_starts_anew():
    done = subprocess.run([sys.executable, "-c", CODE], capture_output=True, text=True, check=True)
    grown, after = map(float, done.stdout.split())
    assert 60.0 < grown < 80.0
    assert after < 8.0
