"""Places whose turns a car can miss: ``python -m benchmarks.turning_roads``, or with ``--map NAME`` for a map of Duckietown.

On a gentle curve there is no turn to miss: a car that steers wrongly for a moment is still in its lane. The rule takes, before any
attack, the first roads of each block sequence of MetaDrive whose route has a sharp turn to the right, two seconds of way before it and
two behind it, and the stretch of that length. One side alone, as the victims are not told where to turn. Of a map of Duckietown it takes the
sharp turns of the route to the right, to both sides, with two seconds of way between them and the one before. It prints what an
experiment file needs: ``world.road``, or ``world.drives_from_m``.
"""

from __future__ import annotations

import argparse
import itertools
import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import Document
from advnerf_core.errors import AdvnerfError
from hardware.worlds.paths import ReferencePath, Segment, segment_length_m
from hardware.worlds.world import WorldDescription
from nodes.lab.worlds.named import read_world

SEQUENCES = ("SX", "ST", "CX", "CT", "SXS", "STS")
SEEDS = range(1, 41)
# A turn that can be missed: at most this radius, in half lanes, at least this angle, and so much way behind it [s].
SHARPEST_HALF_LANES, LEAST_RAD, ONWARD_S = 12.0, math.radians(60.0), 2.0
APPROACH_S = 2.0
_LENGTH_M = 75  # at 6 m/s: 12 m before the turn, a right angle of the largest radius, 12 m behind it, and what the last block has left


@dataclass(frozen=True)
class Turn:
    """Consecutive arcs to one side, each of at most `SHARPEST_HALF_LANES` in radius, that turn by `LEAST_RAD` or more in all.

    Attributes:
        begin_m: Where the first arc begins along the path [m].
        turned_m: The end of the arc at which `LEAST_RAD` are reached [m].
        end_m: The end of the last arc [m].
        angle_rad: Their angles in all, positive to the left [rad].
    """

    begin_m: float
    turned_m: float
    end_m: float
    angle_rad: float


def sharp_turns(path: ReferencePath, half_lane_m: float) -> list[Turn]:
    """All sharp turns along a path. One that goes on beyond the end of a closed path counts as two."""

    def side(segment: Segment) -> float:
        sharp = segment[0] == "arc" and segment[1] <= SHARPEST_HALF_LANES * half_lane_m
        return math.copysign(1.0, segment[2]) if sharp and segment[0] == "arc" else 0.0

    found, along_m = [], 0.0
    for towards, run in itertools.groupby(path.segments, side):
        begin_m = along_m
        turned_rad, turned_m = 0.0, math.inf
        for segment in run:
            along_m += segment_length_m(segment)
            turned_rad += segment[2] if towards and segment[0] == "arc" else 0.0
            if abs(turned_rad) >= LEAST_RAD:
                turned_m = min(turned_m, along_m)
        if turned_m < math.inf:
            found.append(Turn(begin_m, turned_m, along_m, turned_rad))
    return found


def missable_turn_m(path: ReferencePath, half_lane_m: float, onward_m: float) -> float | None:
    """Start of the first sharp turn along a path [m]; None if it is to the left, or has less than ``onward_m`` of way behind it."""
    turn = next(iter(sharp_turns(path, half_lane_m)), None)
    missable = turn is not None and turn.angle_rad < 0.0 and path.length_m - turn.turned_m >= onward_m
    return turn.begin_m if turn is not None and missable else None


def approached_turns_m(path: ReferencePath, half_lane_m: float, approach_m: float) -> list[float]:
    """Places ``approach_m`` before the sharp turns of a closed path [m], of those that are as far from the one before."""
    turns = sharp_turns(path, half_lane_m)
    return [
        (turn.begin_m - approach_m) % path.length_m
        for before, turn in zip([*turns[-1:], *turns], turns, strict=False)
        if (turn.begin_m - before.end_m) % path.length_m >= approach_m
    ]


def main() -> None:
    """Print one line per place found."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--each", type=int, default=1, help="Roads of each block sequence.")
    parser.add_argument("--map", help="A map of Duckietown, in place of roads.")
    options = parser.parse_args()
    if options.map:
        _print_starts(options.map)
    else:
        _print_roads(options.each)


def _print_starts(map_name: str) -> None:
    described = _described({"kind": "duckietown", "map_name": map_name})
    approach_m = APPROACH_S * described.car.speed_mps
    for begin_m in approached_turns_m(described.paths["right"], described.off_track_m, approach_m):
        print(f"world: {{map_name: {map_name}, drives_from_m: {begin_m:.2f}}}")


def _print_roads(wanted: int) -> None:
    for blocks in SEQUENCES:
        found = 0
        for seed in SEEDS:
            road = {"blocks": blocks, "seed": seed, "from_m": 0, "length_m": 400}
            try:
                described = _described({"kind": "metadrive", "road": road})
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


def _described(world: dict[str, Any]) -> WorldDescription:
    with read_world(Document(world, "command line"), Path.cwd()).make() as opened:
        return opened.describe()


if __name__ == "__main__":
    main()
