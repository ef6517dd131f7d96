"""An audit's object and the vehicle's route as ASAM OpenSCENARIO XML 1.2.

The scenario puts the object where the audit judged it, and the vehicle at the start of its reference path, which is assigned as a route: a
simulator then drives the user's own policy past the object. With the parameter ``replay`` the vehicle follows the audit's drive
instead. A place without an OpenDRIVE file has no road network, and none is made up: all positions are world positions.

OpenSCENARIO has the same frames as advnerf (ISO 8855): x forward, y left, z up, a vehicle's origin at its rear axle.
"""

from __future__ import annotations

from datetime import datetime, timezone
from pathlib import Path
from typing import Any

from scenariogeneration import xosc
from scenariogeneration.helpers import prettify

from advnerf_core.files import write_atomically
from advnerf_core.report.audit_result import (
    AuditedDrives,
    AuditedObject,
    AuditedVehicle,
    AuditResult,
    JudgedStart,
    RoutePoint,
)

EGO, OBJECT, REPLAY = "Ego", "Object", "replay"
_MINOR_VERSION = 2
# The format asks for a date; without one the library would write today's.
_NO_DATE = datetime(1970, 1, 1, tzinfo=timezone.utc)
_WAYPOINTS = 30
# Required by the format and not known to an audit, in shares of the wheelbase; the file lists these assumptions.
_LENGTH, _WIDTH, _HEIGHT, _WHEEL, _REAR_OVERHANG = 1.6, 0.65, 0.55, 0.24, 0.3
_MAX_STEERING_RAD, _MAX_ACCELERATION, _OBJECT_MASS_KG = 0.6, 10.0, 1.0


def write_openscenario(file: Path, result: AuditResult) -> None:
    """Write the object that the audit judged and the vehicle's route (extra ``audit``).

    Files that the scenario names (texture, GLB model, road network) are relative to the audit's folder: write it there.
    """
    write_atomically(file, prettify(_scenario(result).get_element(), "utf-8"))


def _scenario(result: AuditResult) -> Any:
    judged, drives = result.strongest, result.judgement
    assert judged is not None, "an object was judged"
    assert result.vehicle is not None, "its size is known"
    drives = drives or judged.judgements[-1]
    parameters = xosc.ParameterDeclarations()
    parameters.add_parameter(xosc.Parameter(REPLAY, xosc.ParameterType.boolean, "false"))
    entities = xosc.Entities()
    entities.add_scenario_object(EGO, _vehicle(result.vehicle))
    entities.add_scenario_object(OBJECT, _misc_object(judged.object))
    return xosc.Scenario(
        result.verdict.sentence,
        f"advnerf {result.versions.get('advnerf', '')}".strip(),
        parameters,
        entities,
        _storyboard(result.vehicle, judged.object, drives),
        xosc.RoadNetwork(roadfile=result.place.road_network),
        xosc.Catalog(),
        osc_minor_version=_MINOR_VERSION,
        creation_date=result.date or _NO_DATE,
    )


def _vehicle(vehicle: AuditedVehicle) -> Any:
    base, assumed = vehicle.wheelbase_m, ["wheels", "maxSpeed", "maxAcceleration", "maxDeceleration"]

    def known(name: str, value: float | None, otherwise: float) -> float:
        if value is None:
            assumed.append(name)
        return otherwise if value is None else value

    length = known("length", vehicle.length_m, _LENGTH * base)
    width = known("width", vehicle.width_m, _WIDTH * base)
    height = known("height", vehicle.height_m, _HEIGHT * base)
    steering = known("maxSteering", vehicle.max_steering_rad, _MAX_STEERING_RAD)
    wheel = _WHEEL * base
    # The box begins behind the rear axle; the overhang at the front follows from the length.
    rear = min(_REAR_OVERHANG * base, 0.5 * max(length - base, 0.0))
    element = xosc.Vehicle(
        vehicle.name,
        xosc.VehicleCategory.car,
        xosc.BoundingBox(width, length, height, 0.5 * length - rear, 0.0, 0.5 * height),
        xosc.Axle(steering, wheel, width, base, 0.5 * wheel),
        xosc.Axle(0.0, wheel, width, 0.0, 0.5 * wheel),
        vehicle.speed_mps,
        _MAX_ACCELERATION,
        _MAX_ACCELERATION,
    )
    element.add_property("assumed", ", ".join(assumed))
    return element


def _misc_object(placed: AuditedObject) -> Any:
    depth, width, height = placed.size_m
    box = xosc.BoundingBox(width, depth, height, 0.0, 0.0, 0.5 * height)
    category = xosc.MiscObjectCategory.obstacle
    element = xosc.MiscObject(placed.name, _OBJECT_MASS_KG, category, box, placed.model)
    element.add_property("kind", placed.kind)
    element.add_property("assumed", "mass")
    if placed.texture_sha256 is not None:
        element.add_property("texture_sha256", placed.texture_sha256)
    if placed.texture is not None:
        element.add_property_file(placed.texture)
    return element


def _storyboard(vehicle: AuditedVehicle, placed: AuditedObject, drives: AuditedDrives) -> Any:
    pose, init = placed.pose, xosc.Init()
    where = xosc.WorldPosition(pose.x_m, pose.y_m, pose.z_m, pose.yaw_rad, pose.pitch_rad, pose.roll_rad)
    init.add_init_action(OBJECT, xosc.TeleportAction(where))
    # Of the stored drive, else of the path, else the first judging start.
    first: list[RoutePoint | JudgedStart] = [*drives.route, *drives.path, *drives.starts]
    init.add_init_action(EGO, xosc.TeleportAction(_position(first[0])))
    step = xosc.TransitionDynamics(xosc.DynamicsShapes.step, xosc.DynamicsDimension.time, 0)
    init.add_init_action(EGO, xosc.AbsoluteSpeedAction(vehicle.speed_mps, step))
    if len(drives.path) > 1:
        init.add_init_action(EGO, xosc.AssignRouteAction(_route(drives.path)))
    last_s = max((points[-1].t_s for points in (drives.path, drives.route) if points), default=60.0)
    ended = xosc.SimulationTimeCondition(last_s, xosc.Rule.greaterThan)
    trigger = xosc.ValueTrigger("end", 0, xosc.ConditionEdge.none, ended, "stop")
    storyboard = xosc.StoryBoard(init, trigger)
    if len(drives.route) > 1:
        storyboard.add_maneuver(_replay(drives.route), EGO)
    return storyboard


def _route(path: tuple[RoutePoint, ...]) -> Any:
    """The path as waypoints: evenly spread points of it, including both ends."""
    count = min(_WAYPOINTS, len(path))
    route = xosc.Route("path")
    for index in range(count):
        route.add_waypoint(
            _position(path[round(index * (len(path) - 1) / (count - 1))]), xosc.RouteStrategy.shortest
        )
    return route


def _replay(route: tuple[RoutePoint, ...]) -> Any:
    """A maneuver that follows the driven trajectory in time, if the parameter asks for it."""
    trajectory = xosc.Trajectory("driven", False)
    trajectory.add_shape(xosc.Polyline([point.t_s for point in route], [_position(point) for point in route]))
    follow = xosc.FollowTrajectoryAction(
        trajectory, xosc.FollowingMode.position, xosc.ReferenceContext.absolute, 1, 0
    )
    event = xosc.Event("follow", xosc.Priority.override)
    event.add_action("follow", follow)
    wanted = xosc.ParameterCondition(REPLAY, "true", xosc.Rule.equalTo)
    event.add_trigger(xosc.ValueTrigger("wanted", 0, xosc.ConditionEdge.none, wanted))
    maneuver = xosc.Maneuver("replay")
    maneuver.add_event(event)
    return maneuver


def _position(point: RoutePoint | JudgedStart) -> Any:
    return xosc.WorldPosition(point.x_m, point.y_m, 0.0, point.yaw_rad)
