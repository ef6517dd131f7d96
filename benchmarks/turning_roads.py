"""Roads of MetaDrive whose turns a car can miss: ``python -m benchmarks.turning_roads``.

On a gentle curve there is no turn to miss: a car that steers wrongly for a moment is still in its lane. The rule takes, before any
attack, the first roads of each block sequence whose route has a sharp turn to the right, two seconds of way before it and two behind
it, and the stretch of that length. One side alone, as the victims are not told where to turn. It prints what an experiment file needs:
``world.road``.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

from advnerf_core.documents import Document
from advnerf_core.errors import AdvnerfError
from hardware.worlds.paths import ReferencePath, segment_length_m
from nodes.lab.worlds.named import read_world

SEQUENCES = ("SX", "ST", "CX", "CT", "SXS", "STS")
SEEDS = range(1, 41)
# A turn that can be missed: at most this radius, in half lanes, at least this angle, and so much way behind it [s].
SHARPEST_HALF_LANES, LEAST_RAD, ONWARD_S = 12.0, math.radians(60.0), 2.0
APPROACH_S = 2.0
_LENGTH_M = 75  # at 6 m/s: 12 m before the turn, a right angle of the largest radius, 12 m behind it, and what the last block has left


def missable_turn_m(path: ReferencePath, half_lane_m: float, onward_m: float) -> float | None:
    """Start of the first sharp turn along a path [m]; None if it is to the left, or has less than ``onward_m`` of way behind it.

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
        if abs(turned_rad) >= LEAST_RAD:
            return begun_m if turned_rad < 0.0 and path.length_m - along_m >= onward_m else None
    return None


def main() -> None:
    """Print one line per road found."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--each", type=int, default=1, help="Roads of each block sequence.")
    wanted = parser.parse_args().each
    for blocks in SEQUENCES:
        found = 0
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
                found += 1
            if found == wanted:
                break


if __name__ == "__main__":
    main()
