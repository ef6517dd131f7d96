"""How old is a frame at a slow consumer? ``python -m benchmarks.frame_age`` (about 25 s).

A camera process publishes 366x188 images at 60 Hz; a consumer takes 50 ms for each. A queue would let them grow old without
bound; ours is drained to the newest. The age is that at the moment of use, from publication.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from benchmarks.results import record_row
from nodes.runtime.bus import Bus
from nodes.runtime.messages import image_message

COMMAND = "python -m benchmarks.frame_age"
TOPIC = "/camera/image_raw"
RATE_HZ, WORK_S = 60.0, 0.05
LIMIT_MS = 1e3 / RATE_HZ + 5.0


def publish(folder: Path, duration_s: float) -> None:
    """The camera: an absolute schedule, no drift."""
    image = np.random.default_rng(0).integers(0, 256, (188, 366, 3), dtype=np.uint8)
    with Bus(folder) as bus:
        bus.publisher(TOPIC)
        bus.wait_for_subscribers([TOPIC], 20.0)
        began = time.monotonic()
        for i in range(round(duration_s * RATE_HZ)):
            time.sleep(max(0.0, began + i / RATE_HZ - time.monotonic()))
            bus.publish(TOPIC, image_message(image, time.time_ns(), "camera"))


def ages_ms(duration_s: float) -> list[float]:
    """Ages at use of all frames that the consumer took [ms]."""
    with tempfile.TemporaryDirectory(prefix="advnerf-age-") as name, Bus(Path(name)) as bus:
        bus.subscribe(TOPIC)
        command = [
            sys.executable,
            "-m",
            "benchmarks.frame_age",
            "--publish",
            name,
            "--duration",
            str(duration_s),
        ]
        camera = subprocess.Popen(command)
        ages: list[float] = []
        try:
            while camera.poll() is None:
                bus.wait(0.2)
                for received in bus.receive():
                    received.message()
                    ages.append((time.monotonic_ns() - received.info.publish_mono_ns) / 1e6)
                    time.sleep(WORK_S)
        finally:
            camera.kill()
            camera.wait()
    if len(ages) < duration_s / WORK_S / 2:
        raise RuntimeError(f"the consumer took only {len(ages)} frames in {duration_s:g} s")
    return ages[1:]  # the first waited for the second process to start


def main() -> None:
    """Measure and record the row."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--trial", action="store_true", help="three seconds; record nothing")
    parser.add_argument("--publish", type=Path, help=argparse.SUPPRESS)
    parser.add_argument("--duration", type=float, default=20.0, help="seconds")
    options = parser.parse_args()
    if options.publish:
        publish(options.publish, options.duration)
        return
    ages = ages_ms(3.0 if options.trial else options.duration)
    p50, p99 = np.percentile(ages, [50, 99])
    note = f"median {p50:.1f} ms, worst {max(ages):.1f} ms, {len(ages)} frames taken"
    print(f"p99 {p99:.1f} ms ({note})")
    if not options.trial:
        record_row(
            "frame age at a consumer of 50 ms per frame, 60 Hz source, p99",
            float(p99),
            "ms",
            f"<= {LIMIT_MS:.1f} ms (one period + 5 ms)",
            bool(p99 <= LIMIT_MS),
            COMMAND,
            note,
        )


if __name__ == "__main__":
    main()
