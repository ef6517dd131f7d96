"""One question per script; each writes its row to ``docs/results.json``."""

import advnerf_core as advnerf_core  # before torch, which then waits as it does in the commands
