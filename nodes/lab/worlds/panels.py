"""Checks of a world that takes textured panels or meshes into its own scene: their place, size, orientation, and occlusion."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from advnerf_core.geometry import Array, invert_transform, make_transform, planar_pose, rotation_z
from hardware.worlds.paths import Pose
from hardware.worlds.world import Mesh, NativeMeshes, NativePanels, Panel, Rgb, require_depth
from nodes.lab.worlds.bench import WorldBench
from nodes.runtime.findings import NotMet

# Distance of the panel ahead of the car, and its width and height, in half lanes.
_AHEAD, _WIDE, _HIGH = 4.0, 1.6, 1.0
# The second view: nearer by this share of the distance, and turned [rad].
_NEARER, _TURNED_RAD = 0.3, 0.12
_CHANGED, _EDGE_PX = 4, 1.5
_OVERLAP, _HIDDEN_OVERLAP, _SAME_DEPTH, _DEPTH_SHARE, _LEAST_PX = 0.8, 0.75, 0.03, 0.9, 150
# A texture whose height is no power of two.
_NAME, _ANOTHER, _TEXELS = "advnerf check", "advnerf check, another", (48, 64)
# Colours of the quarters: top left, top right, bottom left, bottom right.
_QUARTERS = np.array([[225, 30, 30], [30, 200, 30], [30, 30, 225], [215, 205, 30]], dtype=np.uint8)
_WRONG_WAYS = {
    (1, 0, 3, 2): "mirrored left to right; for a viewer its right is the face's y",
    (2, 3, 0, 1): "upside down; row 0 of the texture is on top",
    (3, 2, 1, 0): "turned by half a turn",
}


def panels_are_native(bench: WorldBench) -> str:
    """A panel appears at its place, in its true size, the right way up and not mirrored, in depth too; the ground hides it; it can be removed.

    One that was added before changes nothing of it.
    """
    world = bench.world
    assert isinstance(world, NativePanels), "only asked where the world takes panels"
    return _are_native(bench, lambda name, panel, rgb: world.add_panel(name, panel, rgb))


def meshes_are_native(bench: WorldBench) -> str:
    """So does a mesh: a sheet of the same size."""
    world = bench.world
    assert isinstance(world, NativeMeshes), "only asked where the world takes meshes"
    found = _are_native(
        bench, lambda name, panel, rgb: world.add_mesh(name, None if rgb is None else sheet(panel, rgb))
    )
    place = bench.places[0]
    before = world.observe_at(*place, depth=False)[0]
    turned = _panel(bench, place, float(world.T_car_from_camera[2, 3]))
    back = Panel(turned.T_world_from_face @ planar_pose(0.0, 0.0, math.pi), turned.width_m, turned.height_m)
    try:
        world.add_mesh(_NAME, sheet(back, _texture()))
        if not np.array_equal(world.observe_at(*place, depth=False)[0], before):
            raise NotMet("expected triangles to be seen from their front alone; got one from its back")
    finally:
        world.add_mesh(_NAME, None)
    return found


def _are_native(bench: WorldBench, put: Callable[[str, Panel, Rgb | None], None]) -> str:
    """Check what ``put`` puts where a panel is asked for by a name, or takes out where there is no texture."""
    world, place, half_lane_m = bench.world, bench.places[0], bench.description.off_track_m
    height_m = max(float(world.T_car_from_camera[2, 3]), 0.6 * _HIGH * half_lane_m)
    standing = _panel(bench, place, height_m)
    views = [place, bench.beside(place, _NEARER * _AHEAD * half_lane_m, 0.0, _TURNED_RAD)]
    plain = [world.observe_at(*view) for view in views]
    overlaps = []
    try:
        put(_NAME, standing, _texture())
        for view, (before, _) in zip(views, plain, strict=True):
            overlaps.append(_stands_there(bench, standing, view, before))
        put(_NAME, sunk := _panel(bench, place, 0.0), _texture())
        hidden = _is_hidden_by_the_ground(bench, sunk, place, plain[0][0])
    finally:
        put(_NAME, standing, None)
    for view, (before, _) in zip(views, plain, strict=True):
        if not np.array_equal(world.observe_at(*view, depth=False)[0], before):
            raise NotMet("expected the scene as it was once a panel is taken out; got another picture")
    try:  # the last, as what else moves in the world has moved then
        put(_NAME, standing, _texture())
        _looks_the_same_after_another(bench, standing, place, put)
        _drives_on(bench, place)
    finally:
        put(_NAME, standing, None)
    return (
        f"{100 * min(overlaps):.0f} % of its outline is where it should be, the right way round, at its depth; {100 * hidden:.0f} % where the ground hides "
        "its lower half"
    )


def _looks_the_same_after_another(
    bench: WorldBench, standing: Panel, view: Pose, put: Callable[[str, Panel, Rgb | None], None]
) -> None:
    """Check that what stands alone looks the same once another was put behind it before: the renderer's state may leak from one to the next."""
    world, behind = bench.world, np.array(standing.T_world_from_face)
    behind[:3, 3] -= standing.width_m * behind[:3, 0]
    another = Panel(behind, standing.width_m, standing.height_m)
    alone = world.observe_at(*view, depth=False)[0]
    put(_NAME, standing, None)
    put(_ANOTHER, another, _texture())
    try:
        put(_NAME, standing, _texture())
        beside = world.observe_at(*view, depth=False)[0]
    finally:
        put(_ANOTHER, another, None)
    on_it = _seen(bench, standing, view)[0]
    apart = float(np.abs(beside[on_it].astype(np.float64).mean(axis=0) - alone[on_it].mean(axis=0)).max())
    if apart > _CHANGED:
        raise NotMet(
            f"expected the same colours whether or not another one was added before; got them {apart:.0f} of 255 apart: does the renderer keep a colour, "
            "light or texture of the other?"
        )


def sheet(panel: Panel, rgb: Rgb) -> Mesh:
    """A panel as a mesh of two triangles."""
    # For a viewer right is the face's y.
    left_top, left_low, right_low, right_top = (0.0, 0.0), (0.0, 1.0), (1.0, 1.0), (1.0, 0.0)
    uv = np.array([[left_top, left_low, right_low], [left_top, right_low, right_top]], dtype=np.float32)
    on_face = np.stack(
        [np.zeros((2, 3)), (uv[..., 0] - 0.5) * panel.width_m, (0.5 - uv[..., 1]) * panel.height_m], axis=-1
    )
    T = np.asarray(panel.T_world_from_face)
    corners_m = (on_face @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    normals = np.ascontiguousarray(np.broadcast_to(T[:3, 0].astype(np.float32), (2, 3, 3)))
    return Mesh(corners_m, normals, uv, rgb)


def _drives_on(bench: WorldBench, place: Pose) -> None:
    """A car is put down and drives while a panel is in the scene, also after a picture of it."""
    world, car = bench.world, bench.description.car
    world.reset(*place)
    world.step(0.0, car.speed_mps, bench.tick_s)
    if world.state.speed_mps <= 0.0:
        raise NotMet(
            f"expected the car to drive while a panel stands {_AHEAD:g} half lanes ahead of it; it stands still"
        )


def _panel(bench: WorldBench, place: Pose, height_m: float) -> Panel:
    """A panel ahead of the car that faces it, with its middle at a height."""
    half_lane_m = bench.description.off_track_m
    x, y, yaw = bench.beside(place, _AHEAD * half_lane_m, 0.0, 0.0)
    pose = make_transform(rotation_z(yaw + math.pi), [x, y, height_m])
    return Panel(pose, _WIDE * half_lane_m, _HIGH * half_lane_m)


def _texture() -> Rgb:
    """Four quarters of different colours ``[48, 64, 3]``."""
    return np.ascontiguousarray(
        _QUARTERS.reshape(2, 2, 3).repeat(_TEXELS[0] // 2, axis=0).repeat(_TEXELS[1] // 2, axis=1)
    )


def _stands_there(bench: WorldBench, panel: Panel, view: Pose, before: Rgb) -> float:
    """Check outline, colours and depth of the panel in one view; returns the share of the outline at its place."""
    rgb, depth_m = require_depth(bench.world.observe_at(*view))
    on_it, u, v, z_m = _seen(bench, panel, view)
    if on_it.sum() < _LEAST_PX:
        raise NotMet(
            f"expected a view in which the panel covers {_LEAST_PX} pixels; it covers {int(on_it.sum())}: is the camera's image too small?"
        )
    overlap = _overlap(rgb, before, on_it)
    if overlap < _OVERLAP:
        raise NotMet(
            f"expected the panel, {panel.width_m:.2f} x {panel.height_m:.2f} m, at its place; {100 * overlap:.0f} % of its outline is there: {_where(rgb, before, on_it)}"
        )
    edge = _EDGE_PX / np.sqrt(on_it.sum())
    inner = on_it & (np.abs(u) < 0.5 - edge) & (np.abs(v) < 0.5 - edge)
    _require_the_right_way_round(rgb, inner, u, v, edge)
    apart = np.abs(depth_m[inner] / z_m[inner] - 1.0)
    share = float(np.mean(apart < _SAME_DEPTH))
    if share < _DEPTH_SHARE:
        raise NotMet(
            f"expected the panel's depth where it is seen, as the world's renderer draws it; {100 * share:.0f} % of it is within {100 * _SAME_DEPTH:.0f} %"
        )
    return overlap


def _is_hidden_by_the_ground(bench: WorldBench, panel: Panel, view: Pose, before: Rgb) -> float:
    """Check that only the upper half of a panel whose middle is on the ground is visible; returns the outline's share."""
    rgb, _ = bench.world.observe_at(*view)
    on_it, _, v, _ = _seen(bench, panel, view)
    upper = _overlap(rgb, before, on_it & (v > 0.0))
    if upper < _HIDDEN_OVERLAP:
        raise NotMet(
            f"expected the ground to hide the lower half of a panel whose middle is on it; {100 * upper:.0f} % of the outline of the upper half is right, "
            f"{100 * _overlap(rgb, before, on_it):.0f} % of the whole one: draw it in the scene, not over the picture"
        )
    return upper


def _seen(bench: WorldBench, panel: Panel, view: Pose) -> tuple[NDArray[np.bool_], Array, Array, Array]:
    """Pixels ``[H, W]`` that would see an unoccluded panel; their position on it, as shares of its size, right and up; and their depth [m]."""
    lens = bench.world.camera_pinhole
    T = invert_transform(panel.T_world_from_face) @ planar_pose(*view) @ bench.world.T_car_from_camera
    rays = lens.directions() @ T[:3, :3].T
    with np.errstate(divide="ignore", invalid="ignore"):
        z_m = -T[0, 3] / rays[..., 0]
        u = (T[1, 3] + z_m * rays[..., 1]) / panel.width_m
        v = (T[2, 3] + z_m * rays[..., 2]) / panel.height_m
    return (z_m > 0.0) & (np.abs(u) < 0.5) & (np.abs(v) < 0.5), u, v, z_m


def _changed(rgb: Rgb, before: Rgb) -> NDArray[np.bool_]:
    return np.asarray(np.abs(rgb.astype(np.int16) - before).max(axis=-1) > _CHANGED)


def _overlap(rgb: Rgb, before: Rgb, expected: NDArray[np.bool_]) -> float:
    """Overlap of the changed pixels with the expected ones: intersection over union."""
    changed = _changed(rgb, before)
    return float((changed & expected).sum() / max(int((changed | expected).sum()), 1))


def _where(rgb: Rgb, before: Rgb, expected: NDArray[np.bool_]) -> str:
    """Distance of the changed pixels from the expected ones, for messages."""
    changed = _changed(rgb, before)
    if not changed.any():
        return "nothing in the picture changed"
    (row, column), (wanted_row, wanted_column) = (
        np.argwhere(mask).mean(axis=0) for mask in (changed, expected)
    )
    size = math.sqrt(changed.sum() / expected.sum())
    return (
        f"it is {size:.2f} times as large, and {abs(column - wanted_column):.0f} pixels too far to the {'right' if column > wanted_column else 'left'} and "
        f"{abs(row - wanted_row):.0f} too {'low' if row > wanted_row else 'high'}; width_m and height_m are its full size"
    )


def _require_the_right_way_round(rgb: Rgb, inner: NDArray[np.bool_], u: Array, v: Array, edge: float) -> None:
    """Check that the quarters have the texture's colours in any light."""
    found = []
    for up, right in ((True, False), (True, True), (False, False), (False, True)):
        quarter = inner & ((v > edge) if up else (v < -edge)) & ((u > edge) if right else (u < -edge))
        if not quarter.any():
            raise NotMet("expected all quarters of the panel in view; got a part of it")
        found.append(rgb[quarter].astype(np.float64).mean(axis=0))
    seen = np.array(found)
    for exchanged, order in ((False, seen), (True, seen[:, ::-1])):
        which = tuple(int(np.argmin(_hue_apart(colour))) for colour in order)
        if which == (0, 1, 2, 3) and not exchanged:
            return
        if which == (0, 1, 2, 3):
            raise NotMet(
                "expected the texture's colours; got red and blue exchanged; a texture is red, green, blue"
            )
        if not exchanged and which in _WRONG_WAYS:
            raise NotMet(
                f"expected the panel the right way round for who looks at it; got it {_WRONG_WAYS[which]}"
            )
    raise NotMet(f"expected the colours of the texture's quarters; got {seen.round().astype(int).tolist()}")


def _hue_apart(colour: Array) -> Array:
    """Distance of a colour's hue from each quarter's, for any brightness ``[4]``."""

    def hue(rgb: Array) -> Array:
        shifted = rgb - rgb.min(axis=-1, keepdims=True)
        return np.asarray(shifted / np.maximum(np.linalg.norm(shifted, axis=-1, keepdims=True), 1e-9))

    return np.asarray(np.linalg.norm(hue(_QUARTERS.astype(np.float64)) - hue(colour), axis=-1))
