"""Checks of a world's car and paths: it starts at the requested pose, moves as described, and can drive the paths."""

from __future__ import annotations

import itertools
import math

import numpy as np

from advnerf_core.geometry import Array, wrap_angle
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import CarDescription
from nodes.lab.worlds.bench import WorldBench, pose_of
from nodes.lab.worlds.expert_drive import as_path, drive_expert, lane_expert
from nodes.runtime.findings import MetButLook, NotMet

_RESET_TOLERANCE = 1e-4
# A drive for measurement [s]: its second half, when lags have died away.
_MEASURED_S = 1.2
_TURN_TOLERANCE, _SPEED_TOLERANCE, _SLIP_RAD = 0.25, 0.2, 0.06
# A gain that is off by more is met, but shown: the attack takes the car to be as described.
_GAIN_TO_LOOK_AT = 0.05
# Firmness of the expert [1/m] times half a lane [m], and how far beside a path it starts, of half a lane.
_STIFFNESS_HALF_LANES, _START_ASIDE = 0.35, 0.3


def is_put_down(bench: WorldBench) -> str:
    """The car is at rest at the pose of ``reset``, and has forgotten earlier commands."""
    world, car = bench.world, bench.description.car
    for x, y, yaw in [*bench.places, (*bench.places[0][:2], bench.places[0][2] + 4.0 * math.pi)]:
        world.step(car.control_limits[1], car.speed_mps, bench.tick_s)
        returned = world.reset(x, y, yaw)
        if returned != world.state:
            raise NotMet(f"expected reset to return the state; got {returned}, and a state of {world.state}")
        found = pose_of(world.state)
        off = max(math.dist(found[:2], (x, y)), abs(float(wrap_angle(found[2] - yaw))))
        if not off < _RESET_TOLERANCE:
            raise NotMet(
                f"expected the car at ({x:.3f} m, {y:.3f} m, {yaw:.4f} rad) after reset; got {found.round(4).tolist()}; yaw is in radians"
            )
        if abs(world.state.speed_mps) > _RESET_TOLERANCE:
            raise NotMet(f"expected a car at rest after reset; got {world.state.speed_mps:.3f} m/s")
    straight = _turned_after_reset(bench, 0.0)
    for before in car.control_limits:
        left = abs(_turned_after_reset(bench, before) - straight)
        if left > _RESET_TOLERANCE:
            raise NotMet(
                f"expected reset to forget commands under way; after a control of {before:g} {car.control_unit} and a reset the car turns by {left:.4f} rad "
                "with none"
            )
    return f"within {_RESET_TOLERANCE:g} m and rad at {len(bench.places)} places, at rest, nothing of the last command left"


def moves_as_described(bench: WorldBench) -> str:
    """The car's speed and turn rate agree with kind, speed and wheelbase, up to a small lag and error."""
    car, told, off = bench.description.car, [], 0.0
    for name, path in bench.description.paths.items():
        ratio, speed_ratio, slip_rad = _measured(bench, path)
        if ratio < 0.0:
            raise NotMet(
                f"expected a positive control to turn the car left, so that its yaw grows; on path {name} it turns right; negate the control"
            )
        if abs(speed_ratio - 1.0) > _SPEED_TOLERANCE:
            raise NotMet(
                f"expected {car.speed_mps:g} m/s from a step with that speed; on path {name} the car moves {speed_ratio:.2f} times as fast; speeds are in m/s, "
                "durations in seconds"
            )
        if abs(ratio - 1.0) > _TURN_TOLERANCE:
            raise NotMet(
                f"expected {_law(car)}; on path {name} the car turns {ratio:.2f} times as fast; {_turn_advice(ratio)}"
            )
        if slip_rad > _SLIP_RAD:
            raise NotMet(
                f"expected the state's point to move along its heading; on path {name} it moves {slip_rad:.3f} rad aside: the state is the pose of the rear "
                "axle, not of the body's middle"
            )
        _require_command_kept(bench, path, name)
        told.append(f"{name} turn x {ratio:.2f}, speed x {speed_ratio:.2f}")
        off = max(off, abs(ratio - 1.0), abs(speed_ratio - 1.0))
    found = f"{_law(car)}: {'; '.join(told)}"
    if off > _GAIN_TO_LOOK_AT:
        raise MetButLook(
            f"{found}; that is off by more than {100 * _GAIN_TO_LOOK_AT:.0f} %: unless the car lags as much, look at what step makes of control, speed and "
            "duration, and at the wheelbase"
        )
    return found


def paths_are_drivable(bench: WorldBench) -> str:
    """Paths are continuous, no tighter than the car can turn, free of obstacles, and in a lane; paths with the same start have different goals."""
    paths, car, told = bench.description.paths, bench.description.car, []
    lanes = np.concatenate(
        [_along(lane, 0.2 * bench.description.off_track_m)[:, :2] for lane in bench.description.lanes]
    )
    for name, path in paths.items():
        try:
            exact = as_path(path)
        except ValueError as error:
            raise NotMet(f"path {name}: {error}") from error
        if math.dist(path.pose_at(0.0)[:2], path.start_pose[:2]) > 1e-9:
            raise NotMet(f"path {name}: expected it to begin at its start pose; got {path.pose_at(0.0)}")
        curvature = float(np.abs(exact.curvature_at(np.linspace(0.0, exact.length_m, 400))).max())
        needed = _wanted_control(car, curvature)
        if needed > min(-car.control_limits[0], car.control_limits[1]):
            raise NotMet(
                f"path {name}: expected curves that the car can follow; its tightest, of {1.0 / curvature:.2f} m, takes a control of {needed:.3f} "
                f"{car.control_unit}, and the limits are {car.control_limits}"
            )
        for pose in _along(path, bench.description.off_track_m, bench.driven_m(path)):
            bench.world.reset(*map(float, pose))
            if bench.world.blocked:
                raise NotMet(
                    f"path {name}: expected it to be free; the car is blocked at {pose.round(2).tolist()}"
                )
        apart = np.linalg.norm(
            _along(path, 0.5 * bench.description.off_track_m)[:, None, :2] - lanes[None], axis=2
        ).min(axis=1)
        if apart.max() > bench.description.off_track_m:
            raise NotMet(
                f"path {name}: expected lanes to have all paths among them; it runs {apart.max():.2f} m beside all of them"
            )
        told.append(
            f"{name} {path.length_m:.1f} m, control up to {needed:.2f} of {car.largest_control:g} {car.control_unit}"
        )
    for (one, first), (other, second) in itertools.combinations(paths.items(), 2):
        if (
            math.dist(first.start_pose[:2], second.start_pose[:2]) < bench.description.off_track_m
            and first.goal == second.goal
        ):
            raise NotMet(
                f"paths {one} and {other} begin at one place: expected different goals, or no policy can tell them apart; got {list(first.goal)} twice"
            )
    return "; ".join(told)


def expert_keeps_its_lane(bench: WorldBench) -> str:
    """The project's expert, given the true state, stays in its lane on every path, from a start beside it."""
    told, car, half_lane_m = [], bench.description.car, bench.description.off_track_m
    for name, path in bench.description.paths.items():
        expert = lane_expert(as_path(path), car, bench.tick_s, _STIFFNESS_HALF_LANES / half_lane_m)
        ticks = max(int(bench.driven_m(path) / car.speed_mps / bench.tick_s), 1)
        start = bench.beside(path.start_pose, 0.0, _START_ASIDE * half_lane_m, 0.0)
        drive = drive_expert(bench.world, expert, start, ticks, bench.tick_s)
        worst = float(np.abs(drive.cte_m).max())
        if drive.blocked_tick is not None:
            raise NotMet(
                f"expected the expert to drive path {name}; the car runs into something after {drive.blocked_tick} ticks, {worst:.2f} m off the path"
            )
        if worst > half_lane_m:
            raise NotMet(
                f"expected the expert to stay within {half_lane_m:g} m of path {name}; it is {worst:.2f} m off: does the car do what the description says?"
            )
        told.append(f"{name} {worst:.2f} m")
    return f"farthest from the path in {bench.tick_s:g} s ticks: {', '.join(told)}; half a lane is {half_lane_m:g} m"


def _turned_after_reset(bench: WorldBench, control: float) -> float:
    """Change of heading [rad] over a tick without control, after driving with one and a reset."""
    world, car = bench.world, bench.description.car
    world.reset(*bench.places[0])
    for _ in range(3):
        world.step(control, car.speed_mps, bench.tick_s)
    start = world.reset(*bench.places[0])
    return float(wrap_angle(world.step(0.0, car.speed_mps, bench.tick_s).yaw_rad - start.yaw_rad))


def _measured(bench: WorldBench, path: ReferencePath) -> tuple[float, float, float]:
    """Turn rate and speed relative to the description, and the largest angle between heading and motion [rad], in drives along a path."""
    car, ticks = bench.description.car, max(round(_MEASURED_S / bench.tick_s), 4)
    way_m = ticks * bench.tick_s * car.speed_mps
    x, y, yaw = path.pose_at(0.0)
    bend_1pm = float(wrap_angle(path.pose_at(0.5 * way_m)[2] - yaw)) / (0.5 * way_m)
    # Additional curvature that ends the drive half a lane aside.
    more_1pm = min(bench.description.off_track_m / way_m**2, 0.3 * _largest_curvature(car))
    rates, speeds, slips = [], [], []
    for sign in (1.0, -1.0):
        control = _control(car, bend_1pm + sign * more_1pm)
        bench.world.reset(x, y, yaw)
        poses = [pose_of(bench.world.step(control, car.speed_mps, bench.tick_s)) for _ in range(ticks)]
        if bench.world.blocked:
            raise NotMet(
                f"expected room for {_MEASURED_S} s of driving from where the paths begin; the car runs into something; begin them elsewhere"
            )
        rate, speed, slip = _steady(np.array(poses[ticks // 2 :]), bench.tick_s)
        rates.append(rate)
        speeds.append(speed)
        slips.append(slip)
    expected = 2.0 * more_1pm * car.speed_mps
    return (rates[0] - rates[1]) / expected, float(np.mean(speeds)) / car.speed_mps, max(slips)


def _require_command_kept(bench: WorldBench, path: ReferencePath, name: str) -> None:
    """Raise unless a step returns the state, and the car moves at the state's speed, and by the speed and duration of the command."""
    car, tick_s = bench.description.car, bench.tick_s
    one_m, told_mps, free = _way_of_a_step(bench, path, car.speed_mps, tick_s)
    slow_m = _way_of_a_step(bench, path, 0.5 * car.speed_mps, tick_s)[0]
    long_m, _, still_free = _way_of_a_step(bench, path, car.speed_mps, 2.0 * tick_s)
    if not (free and still_free):
        return  # `blocked` tells of it
    for what, share in (
        (
            f"a state's speed of {one_m / tick_s:.3g} m/s, at which the car moves; got {told_mps:.3g} m/s",
            told_mps * tick_s / one_m,
        ),
        (
            f"half the way with half the speed; the car moves {slow_m / one_m:.2f} times as far: obey speed_mps",
            2.0 * slow_m / one_m,
        ),
        (
            f"twice the way in {2.0 * tick_s:g} s as in {tick_s:g} s; the car moves {long_m / one_m:.2f} times as far: obey duration_s",
            0.5 * long_m / one_m,
        ),
    ):
        if abs(share - 1.0) > _SPEED_TOLERANCE:
            raise NotMet(f"on path {name}: expected {what}")


def _way_of_a_step(
    bench: WorldBench, path: ReferencePath, speed_mps: float, duration_s: float
) -> tuple[float, float, bool]:
    """Way of a step [m] after others of its speed, the speed of the state after it [m/s], and whether nothing is in the way."""
    world = bench.world
    world.reset(*path.pose_at(0.0))
    for _ in range(max(round(_MEASURED_S / bench.tick_s), 4)):
        world.step(0.0, speed_mps, bench.tick_s)
    before = world.state
    after = world.step(0.0, speed_mps, duration_s)
    if after != world.state:
        raise NotMet(f"expected step to return the state; got {after}, and a state of {world.state}")
    way_m = math.dist((after.x_m, after.y_m), (before.x_m, before.y_m))
    return way_m, world.state.speed_mps, not world.blocked


def _steady(poses: Array, tick_s: float) -> tuple[float, float, float]:
    """Turn rate [rad/s], speed [m/s] and angle between heading and motion [rad] of poses ``[N, 3]`` at the ticks."""
    steps, turns = np.diff(poses[:, :2], axis=0), np.diff(np.unwrap(poses[:, 2]))
    way = np.linalg.norm(steps, axis=1)
    course = np.arctan2(steps[:, 1], steps[:, 0])
    # A chord points half-way through its turn.
    aside = np.abs(wrap_angle(course - poses[:-1, 2] - 0.5 * turns))
    return float(turns.mean()) / tick_s, float(way.mean()) / tick_s, float(aside.max())


def _control(car: CarDescription, curvature_1pm: float) -> float:
    """Control that turns the described car along a curvature, within its limits."""
    return float(np.clip(_wanted_control(car, curvature_1pm), *car.control_limits))


def _wanted_control(car: CarDescription, curvature_1pm: float) -> float:
    if car.wheelbase_m is None:
        return car.speed_mps * curvature_1pm
    return math.atan(car.wheelbase_m * curvature_1pm)


def _largest_curvature(car: CarDescription) -> float:
    """Largest curvature of the tighter side [1/m]."""
    limit = min(-car.control_limits[0], car.control_limits[1])
    return limit / car.speed_mps if car.wheelbase_m is None else math.tan(limit) / car.wheelbase_m


def _law(car: CarDescription) -> str:
    if car.wheelbase_m is None:
        return "a turn rate equal to the control [rad/s]"
    return f"a turn rate of speed / {car.wheelbase_m:g} m x tan(control [rad])"


def _turn_advice(ratio: float) -> str:
    if ratio > 20.0 or ratio < 0.05:
        return "is an angle in degrees?"
    return "correct kind, wheelbase_m or the unit of the control in the description"


def _along(path: ReferencePath, spacing_m: float, length_m: float | None = None) -> Array:
    """Poses ``[N, 3]`` along a path, or its first part."""
    until = path.length_m if length_m is None else length_m
    return np.array([path.pose_at(float(s)) for s in np.linspace(0.0, until, 2 + int(until / spacing_m))])
