"""How old is the picture on the operator's screen? ``python -m benchmarks.page_latency [--seconds S] [--minutes M]``.

The whole simulated lab runs at 10 Hz with the page in Chromium on the same computer. Glass to glass is the time from an image's
capture stamp to the animation frame after the page has drawn it; both use the clock of this computer. The latency from capture to
the policy's command is measured with and without the page, and the memory of node and tab over ``--minutes``.
"""

from __future__ import annotations

import argparse
import time
from typing import Any

import numpy as np
import psutil

from benchmarks.results import record_row
from nodes.runtime.messages import stamp_ns
from tests.support.live.operator import LiveOperator
from tests.support.live.page_browser import Phone, available, live_page

COMMAND = "python -m benchmarks.page_latency"
_RECORDED_S = 60.0
_LIMIT_MS = 150.0
_DESK = {"viewport": {"width": 1400, "height": 900}}
# A canvas carries the stamp of what is drawn on it. The frame after the drawing is the one that the screen shows.
_WATCH = """() => {
  window.shown = [[], [], []];
  window.watching = [];
  document.querySelectorAll('#pictures canvas').forEach((canvas, channel) => {
    const observer = new MutationObserver(() => {
      const stamp = Number(BigInt(canvas.dataset.stamp) / 1000n) / 1000;
      requestAnimationFrame(() => window.shown[channel].push(performance.timeOrigin + performance.now() - stamp));
    });
    observer.observe(canvas, { attributeFilter: ['data-stamp'] });
    window.watching.push(observer);
  });
}"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=_RECORDED_S)
    parser.add_argument("--minutes", type=float, default=0.0, help="watch the memory for so long")
    options = parser.parse_args()
    if not available():
        raise SystemExit("needs chromium and playwright")
    from playwright.sync_api import sync_playwright

    with live_page("record=false") as operator, sync_playwright() as playwright:
        alone = command_ms(operator, options.seconds)
        phone = Phone(playwright, operator.run_dir, options=_DESK)
        page = phone.open()
        page.wait_for_timeout(3000)
        shown = glass_ms(page, options.seconds)
        watched = command_ms(operator, options.seconds)
        memory = memory_mb(operator, page, options.minutes) if options.minutes else {}
        phone.close()
    report(shown, alone, watched, memory, options)


def glass_ms(page: Any, seconds: float) -> list[list[float]]:
    """Capture to screen of each channel [ms]."""
    page.evaluate(_WATCH)
    page.wait_for_timeout(1000 * seconds)
    shown: list[list[float]] = page.evaluate("() => window.shown")
    # What is kept for the figures must not count as the page's memory later.
    page.evaluate(
        "() => { window.watching.forEach(each => each.disconnect()); window.shown = [[], [], []]; }"
    )
    return shown


def command_ms(operator: LiveOperator, seconds: float) -> list[float]:
    """Capture to the policy's command [ms]."""
    operator.watch(0.5)
    since = time.time_ns()
    found = []
    operator.bus.subscribe("/policy/drive", queue=50)
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline:
        operator.bus.wait(0.1)
        for received in operator.bus.receive():
            if received.topic == "/policy/drive":
                stamp = stamp_ns(received.message())
                if stamp > since:
                    found.append((received.info.publish_real_ns - stamp) / 1e6)
    return found


def memory_mb(operator: LiveOperator, page: Any, minutes: float) -> dict[str, tuple[float, float]]:
    """Memory of the node's process and of the tab's scripts, after the first minute and at the end [MB]."""
    session = page.context.new_cdp_session(page)
    node = psutil.Process(operator.pid_of("page"))

    def now() -> dict[str, float]:
        session.send("HeapProfiler.collectGarbage")
        heap = session.send("Runtime.getHeapUsage")["usedSize"] / 1e6
        return {"node": node.memory_info().rss / 1e6, "tab": heap}

    page.wait_for_timeout(60_000)
    first = now()
    page.wait_for_timeout(60_000 * minutes)
    last = now()
    return {name: (first[name], last[name]) for name in first}


def report(
    shown: list[list[float]],
    alone: list[float],
    watched: list[float],
    memory: dict[str, tuple[float, float]],
    options: Any,
) -> None:
    """Print the figures, and record those of a full run."""
    names = ("camera", "attacked picture")
    parts = [f"{name}: {len(each)} pictures, median {np.median(each):.0f} ms, p95 {np.percentile(each, 95):.0f} ms" for name, each in zip(names, shown, strict=False)]  # fmt: skip
    p95 = max(float(np.percentile(each, 95)) for each in shown[:2])
    stack = [float(np.percentile(each, q)) for each in (alone, watched) for q in (50, 95)]
    print("; ".join(parts))
    beside = f"capture to command p50/p95: {stack[0]:.1f}/{stack[1]:.1f} ms without the page open, {stack[2]:.1f}/{stack[3]:.1f} ms with it"
    print(f"{beside}; {len(alone)} and {len(watched)} commands")
    for name, (first, last) in memory.items():
        print(
            f"memory of the {name}: {first:.1f} MB after a minute, {last:.1f} MB after {options.minutes:g} more"
        )
    if options.seconds == _RECORDED_S:
        record_row("operator page, glass to glass at 10 Hz on the loopback, p95", round(p95), "ms", f"<= {_LIMIT_MS:g} ms", p95 <= _LIMIT_MS, COMMAND, "; ".join(parts))  # fmt: skip
        rate = len(watched) / len(alone)
        record_row("drive commands with the operator page open, compared with without", rate, "x", ">= 0.98", rate >= 0.98, COMMAND, beside)  # fmt: skip
    for name, (first, last) in memory.items():
        grown = 100.0 * (last / first - 1.0)
        record_row(f"memory of the operator page's {name} over {options.minutes:g} minutes", grown, "%", "<= 2 % in an hour", None if options.minutes < 60 else grown <= 2.0, f"{COMMAND} --minutes {options.minutes:g}", f"{first:.1f} to {last:.1f} MB")  # fmt: skip


if __name__ == "__main__":
    main()
