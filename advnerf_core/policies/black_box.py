"""Methods of attack that ask a policy for its answers only, and so work on one without a gradient."""

from __future__ import annotations

BLACK_BOX_METHODS = ("guided", "distilled", "evolution", "cem", "random")
BLACK_BOX_METHODS_TEXT = f"{', '.join(BLACK_BOX_METHODS[:-1])} or {BLACK_BOX_METHODS[-1]}"
