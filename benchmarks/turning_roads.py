"""Roads of MetaDrive whose turns a car can miss: ``python -m benchmarks.turning_roads``.

On a gentle curve there is no turn to miss: a car that steers wrongly for a moment is still in its lane. The rule takes, before any
attack, the first road of each block sequence whose route has a sharp turn, two seconds of way before it and two behind it, and the
stretch of that length. It prints what an experiment file needs: ``world.road``.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from advnerf_core.documents import Document
from advnerf_core.errors import AdvnerfError
from hardware.worlds.paths import ReferencePath, segment_length_m
from nodes.lab.worlds.named import read_world

SEQUENCES = ("SX", "ST", "CX", "CT", "SXS", "STS", "SO", "CO")
SEEDS = range(1, 13)
# A turn that can be missed: at most this radius, in half lanes, at least this angle, and so much way behind it [s].
SHARPEST_HALF_LANES, LEAST_RAD, ONWARD_S = 12.0, math.radians(60.0), 2.0
APPROACH_S = 2.0
_LENGTH_M = 75  # at 6 m/s: 12 m before the turn, a right angle of the largest radius, 12 m behind it, and what the last block has left


def missable_turn_m(path: ReferencePath, half_lane_m: float, onward_m: float) -> float | None:
    """Start of the first sharp turn along a path [m]; None without one that has at least ``onward_m`` of way behind it.

    Sharp are consecutive arcs to one side, each of at most `SHARPEST_HALF_LANES` in radius, that turn by `LEAST_RAD` in all.
    """
    along_m = begun_m = turned_rad = 0.0
    for segment in path.segments:
        sharp = segment[0] == "arc" and segment[1] <= SHARPEST_HALF_LANES * half_lane_m
        angle_rad = segment[2] if sharp and segment[0] == "arc" else 0.0
        if not sharp or angle_rad * turned_rad < 0.0:
            begun_m, turned_rad = along_m, 0.0
        along_m, turned_rad = along_m + segment_length_m(segment), turned_rad + angle_rad
        if not sharp:
            begun_m = along_m
        if abs(turned_rad) >= LEAST_RAD and path.length_m - along_m >= onward_m:
            return begun_m
    return None


def main() -> None:
    """Print one line per road found."""
    argparse.ArgumentParser(description=__doc__).parse_args()
    for blocks in SEQUENCES:
        for seed in SEEDS:
            road = {"blocks": blocks, "seed": seed, "from_m": 0, "length_m": 400}
            named = read_world(Document({"kind": "metadrive", "road": road}, "command line"), Path.cwd())
            try:
                with named.make() as world:
                    described = world.describe()
            except AdvnerfError as error:
                print(f"# {blocks} {seed}: {error}", flush=True)
                continue
            path, speed_mps = described.paths["route"], described.car.speed_mps
            turn_m = missable_turn_m(path, described.off_track_m, ONWARD_S * speed_mps)
            if turn_m is not None and turn_m >= APPROACH_S * speed_mps:
                from_m = math.floor(turn_m - APPROACH_S * speed_mps)
                print(
                    f"road: {{blocks: {blocks}, seed: {seed}, from_m: {from_m}, length_m: {_LENGTH_M}}}",
                    flush=True,
                )
                break


if __name__ == "__main__":
    main()
