"""Checks of a world's pictures: their form and repeatability, that observing takes no time, and that photographs match the car's view."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, planar_pose
from hardware.worlds.world import Rgb, require_depth, traits_of
from nodes.lab.worlds.bench import WorldBench, pose_of
from nodes.lab.worlds.held import require_depth_of, require_picture
from nodes.runtime.findings import MetButLook, NotMet, form_of

# Below this spread a picture counts as one colour [grey levels].
_LEAST_SPREAD = 1.0
_LEAST_DEPTH_SHARE = 0.3
# A photograph and the driving camera's view from the same pose: correlation of their grey values, and mean difference [grey levels].
_LEAST_CORRELATION, _CORRELATION_TO_LOOK_AT, _LARGEST_DIFFERENCE = 0.85, 0.97, 16.0
_COLOURLESS = 3.0
_LEAST_OVERLAP = 0.2
# A picture after a step may differ by this share of the step's change, as the car's own body may be in it.
_LATE_SHARE = 0.25
_AHEAD_S = 0.3


def form(bench: WorldBench) -> str:
    """Sizes, types and ranges of colours, depth and photographs; each call returns a new array."""
    world, camera, photo = bench.world, bench.world.camera_pinhole, bench.world.photo_pinhole
    finite = []
    for place in bench.places:
        rgb, depth = world.observe_at(*place)
        require_picture(rgb, camera, "observe_at")
        _require_something(rgb, "observe_at")
        require_depth_of(depth, camera, "observe_at")
        assert depth is not None
        finite.append(float(np.isfinite(depth).mean()))
        kept, kept_depth = rgb.copy(), depth.copy()
        world.observe_at(*bench.beside(place, 0.0, 0.0, 0.5))
        if not (np.array_equal(kept, rgb) and np.array_equal(kept_depth, depth, equal_nan=True)):
            raise NotMet(
                "expected a new array from each call; got one that the next call writes into; return a copy"
            )
    if min(finite) < _LEAST_DEPTH_SHARE:
        raise NotMet(
            f"expected finite depth in {100 * _LEAST_DEPTH_SHARE:.0f} % of every view, as the ground alone fills; got {100 * min(finite):.0f} %"
        )
    without = world.observe_at(*bench.places[0], depth=False)[1]
    if without is not None:
        raise NotMet(f"expected None for the depth of observe_at(depth=False); got {form_of(without)}")
    photograph = world.photograph(planar_pose(*bench.places[0]) @ world.T_car_from_camera)
    require_picture(photograph, photo, "photograph")
    _require_something(photograph, "photograph")
    return f"views {camera.width} x {camera.height}, photographs {photo.width} x {photo.height}, depth finite in {100 * min(finite):.0f} % of each view or more"


def repeats(bench: WorldBench) -> str:
    """The same calls give the same bytes, with any calls in between."""
    first = _script(bench)
    bench.world.reset(*bench.places[-1])
    bench.world.step(
        bench.description.car.control_limits[0], bench.description.car.speed_mps, 3 * bench.tick_s
    )
    bench.world.observe_at(*bench.places[1])
    again = _script(bench)
    for (name, one), (_, other) in zip(first, again, strict=True):
        if not np.array_equal(one, other, equal_nan=name == "depth"):
            differ = float(np.mean(np.asarray(one) != np.asarray(other)))
            raise NotMet(
                f"expected the same bytes from the same calls; got another {name} in {100 * differ:.1f} % of its values; seed what is drawn, and let "
                "reset forget everything"
            )
    return f"{len(first)} results of the same calls are equal to the byte"


def takes_no_time(bench: WorldBench) -> str:
    """The car and its view do not change while the world is observed, photographed and described."""
    world, car = bench.world, bench.description.car
    world.reset(*bench.places[0])
    world.step(0.3 * car.control_limits[1], car.speed_mps, 3 * bench.tick_s)
    before, view = world.state, world.observe()[0].copy()
    looks: dict[str, Any] = {
        "observe": world.observe,
        "observe_at": lambda: world.observe_at(*bench.places[-1]),
        "photograph": lambda: world.photograph(planar_pose(*bench.places[1]) @ world.T_car_from_camera),
        "photo_poses": lambda: world.photo_poses(3, np.random.default_rng(0)),
        "describe": world.describe,
        "blocked": lambda: world.blocked,
    }
    for name, look in looks.items():
        look()
        moved = np.abs(pose_of(world.state) - pose_of(before)).max()
        if world.state != before:
            raise NotMet(
                f"expected time to pass in step only; {name} changes the car's state (by {moved:.3g} m or rad, or its speed)"
            )
        if not np.array_equal(world.observe()[0], view):
            raise NotMet(f"expected time to pass in step only; the car sees something else after {name}")
    return f"the car stands through {', '.join(looks)}"


def is_not_late(bench: WorldBench) -> str:
    """The view after a step is the view from the new pose, not from the last one."""
    world, car = bench.world, bench.description.car
    worst, compared = 0.0, 0
    for place in bench.places[::3]:
        world.reset(*place)
        world.observe()
        ticks = max(round(_AHEAD_S / bench.tick_s), 1)
        for _ in range(2):
            before = world.state
            for _ in range(ticks):
                world.step(0.5 * car.control_limits[1], car.speed_mps, bench.tick_s)
            seen = world.observe()[0]
            here, there = (
                world.observe_at(s.x_m, s.y_m, s.yaw_rad, depth=False)[0] for s in (world.state, before)
            )
            change, late = _difference(here, there), _difference(seen, here)
            if change < 0.5:
                continue  # without a change there is no delay to see
            compared += 1
            worst = max(worst, late / change)
    if not compared:
        raise NotMet(
            f"expected views that change while the car drives for {_AHEAD_S} s; got the same picture everywhere; does observe_at look from its pose?"
        )
    if worst > _LATE_SHARE:
        raise NotMet(
            f"expected observe to show what observe_at shows from the car's state; got a difference of {100 * worst:.0f} % of what {_AHEAD_S} s of "
            "driving change: the picture is late, or is taken from elsewhere; draw it after the car has moved"
        )
    return f"observe after a step differs from observe_at by at most {100 * worst:.1f} % of what {_AHEAD_S} s of driving change"


def photographs_match(bench: WorldBench) -> str:
    """A photograph from the driving camera's pose shows the driving camera's view: the same meaning of poses, the same order of colours."""
    world, correlations, plain, swapped, colour = bench.world, [], [], [], []
    for place in bench.places:
        T = planar_pose(*place) @ world.T_car_from_camera
        seen, there = _seen_by_both(world.observe_at(*place, depth=False)[0], world.photograph(T), bench)
        if there.mean() < _LEAST_OVERLAP:
            raise NotMet(
                f"expected photo_pinhole to see at least {100 * _LEAST_OVERLAP:.0f} % of what camera_pinhole sees; got {100 * there.mean():.0f} %; "
                "give photographs a wider field of view"
            )
        view, photo = (each[there].astype(np.float64) for each in seen)
        grey = [each.mean(axis=-1) for each in (view, photo)]
        correlations.append(float(np.corrcoef(*grey)[0, 1]) if min(map(np.std, grey)) > 0.0 else 0.0)
        plain.append(float(np.abs(view - photo).mean()))
        swapped.append(float(np.abs(view - photo[:, ::-1]).mean()))
        colour.append(float(np.abs(view[:, 0] - view[:, 2]).mean()))
    if np.median(correlations) < _LEAST_CORRELATION:
        raise NotMet(
            f"expected photograph(T_world_from_camera) to show what the driving camera sees from there; got a correlation of {np.median(correlations):.2f}; "
            "is T taken for camera to world, with axes x right, y down, z forward?"
        )
    if np.mean(swapped) < 0.8 * np.mean(plain):
        raise NotMet(
            f"expected colours in the order red, green, blue everywhere; got photographs that differ by {np.mean(plain):.1f} grey levels from the driving "
            f"camera, and by {np.mean(swapped):.1f} with red and blue exchanged: one of the two is blue, green, red"
        )
    if np.mean(plain) > _LARGEST_DIFFERENCE and not traits_of(world).own_photo_colours:
        raise NotMet(
            f"expected photographs in the driving camera's colours; got a difference of {np.mean(plain):.1f} grey levels, at most {_LARGEST_DIFFERENCE:g} "
            "will do, unless the world's traits say own_photo_colours"
        )
    told = (
        "too grey to tell the order of colours"
        if np.mean(colour) < _COLOURLESS
        else "the same order of colours (whether that is red, green, blue only a look at -o tells)"
    )
    found = f"correlation {np.median(correlations):.3f}, difference {np.mean(plain):.1f} grey levels; {told}"
    if np.median(correlations) < _CORRELATION_TO_LOOK_AT:
        raise MetButLook(
            f"{found}; a correlation below {_CORRELATION_TO_LOOK_AT:g} is unusual: look at both with -o, and at T_car_from_camera, camera_pinhole and photo_pinhole"
        )
    return found


def _script(bench: WorldBench) -> list[tuple[str, NDArray[Any]]]:
    """Results of a fixed sequence of calls."""
    world, car = bench.world, bench.description.car
    found: list[tuple[str, NDArray[Any]]] = [("state", pose_of(world.reset(*bench.places[0])))]
    for control in (0.0, 0.4 * car.control_limits[0], 0.3 * car.control_limits[1]):
        found.append(("state", pose_of(world.step(control, car.speed_mps, bench.tick_s))))
        rgb, depth = require_depth(world.observe())
        found += [("picture", rgb), ("depth", depth)]
    found.append(("picture", world.observe_at(*bench.places[-1], depth=False)[0]))
    poses = world.photo_poses(4, np.random.default_rng(1))
    return [*found, ("photo pose", np.array(poses)), ("photograph", world.photograph(poses[0]))]


def _require_something(rgb: Rgb, name: str) -> None:
    if float(rgb.std()) < _LEAST_SPREAD:
        raise NotMet(
            f"expected something to be seen in {name}; got a picture of one colour, {rgb.reshape(-1, 3)[0].tolist()}"
        )


def _difference(one: Rgb, other: Rgb) -> float:
    """Mean absolute difference [grey levels]."""
    return float(np.abs(one.astype(np.int16) - other.astype(np.int16)).mean())


def _seen_by_both(view: Rgb, photo: Rgb, bench: WorldBench) -> tuple[tuple[Rgb, Rgb], NDArray[np.bool_]]:
    """The driving camera's picture and the photograph resampled to that camera, both a little blurred; and a mask of the photograph.

    Both look from one point, so that a pixel's direction alone gives its position in the other picture.
    """
    lens, camera = bench.world.photo_pinhole, bench.world.camera_pinhole
    pixels: Array = lens.project(camera.directions())
    there = (
        (pixels[..., 0] > 1)
        & (pixels[..., 0] < lens.width - 1)
        & (pixels[..., 1] > 1)
        & (pixels[..., 1] < lens.height - 1)
    )
    maps = (pixels - 0.5).astype(np.float32)  # OpenCV puts pixel centres at whole numbers
    sampled = cv2.remap(
        photo, maps[..., 0], maps[..., 1], interpolation=cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    blurred = [np.asarray(cv2.blur(each, (5, 5)), dtype=np.uint8) for each in (view, sampled)]
    return (blurred[0], blurred[1]), there
