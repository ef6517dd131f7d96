"""Makes the pictures of docs/operator_page.md: ``python -m benchmarks.page_pictures RUN`` (a minute).

RUN is the folder of an experiment in the room, such as ``runs/demo``, for its policy and its attacks.
"""

from __future__ import annotations

import argparse
from io import BytesIO
from pathlib import Path
from typing import Any

from PIL import Image

from advnerf_core.files import write_atomically
from benchmarks.results import REPOSITORY
from tests.support.live.operator import LiveOperator
from tests.support.live.page_browser import PHONE, Phone, available, live_page

_DESK = {"viewport": {"width": 1360, "height": 1130}}
_QUALITY, _WIDTH_PX = 78, {"desk": 1100, "phone": 420}
_TRIES = 20


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("run", type=Path)
    options = parser.parse_args()
    if not available():
        raise SystemExit("needs chromium and playwright")
    from playwright.sync_api import sync_playwright

    cells = [options.run / "cells" / f"track_hardened_{name}_0" for name in ("gradient", "random")]
    attacks = ",".join(str((cell / "attack.safetensors").resolve()) for cell in cells)
    policy = (options.run / "policy" / "policy.safetensors").resolve()
    settings = (f"params.policy={policy}", f"params.attacks=[{attacks}]", "params.counterfactual=true")
    with live_page(*settings, straight=False) as operator, sync_playwright() as playwright:
        for name, context in (("desk", _DESK), ("phone", {**PHONE, "color_scheme": "dark"})):
            phone = Phone(playwright, operator.run_dir, options=context)
            page = phone.open()
            phone.take()
            page.evaluate("document.querySelector('#attacks button').click()")
            drive(operator, phone)
            save("operator_page", name, page.screenshot())
            phone.let_go()
            page.evaluate("document.getElementById('leave').click()")
            phone.close()


def drive(operator: LiveOperator, phone: Phone) -> None:
    """Hold until the car has driven past the attack for a while."""
    page: Any = phone.page
    for _ in range(_TRIES):
        page.evaluate("document.getElementById('trial').click()")
        page.evaluate("scrollTo(0, 0)")
        page.wait_for_timeout(300)
        phone.hold()
        page.wait_for_timeout(3600)
        operator.watch()
        if operator.armed and "is shown" in page.inner_text("#attack-text"):
            return
        phone.let_go()
        page.wait_for_timeout(500)
        # The trial may have ended by itself meanwhile; a click by script waits for nothing.
        page.evaluate("document.getElementById('trial_end').click()")
        page.wait_for_timeout(500)
    raise TimeoutError(f"the car did not drive with the attack: {operator.describe()}")


def save(page: str, name: str, png: bytes) -> None:
    """Write a small WebP picture into the documentation.

    Args:
        page: What it shows: the first part of the file's name.
        name: ``desk`` or ``phone``.
        png: The screenshot.
    """
    image = Image.open(BytesIO(png)).convert("RGB")
    width = _WIDTH_PX[name]
    image = image.resize((width, round(image.height * width / image.width)), Image.Resampling.LANCZOS)
    out = BytesIO()
    image.save(out, "WEBP", quality=_QUALITY, method=6)
    file = REPOSITORY / "docs" / f"{page}_{name}.webp"
    write_atomically(file, out.getvalue())
    print(f"{file.relative_to(REPOSITORY)}: {len(out.getvalue()) / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
