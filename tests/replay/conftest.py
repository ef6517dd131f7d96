"""The modules beside the tests: a maker of bags and a policy that launch files can name."""

import sys
from pathlib import Path

sys.path.append(str(Path(__file__).parent))
