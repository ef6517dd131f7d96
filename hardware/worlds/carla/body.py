"""The car in CARLA's world: the experiment's Dubins car, the vehicle actor that shows it, and collision tests."""

from __future__ import annotations

from typing import Any

from advnerf_core.geometry import Array, VehicleState, planar_pose, transform_points
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.carla.errors import CarlaError, CarlaMapError
from hardware.worlds.carla.frames import CarlaPose, SceneFrame
from hardware.worlds.carla.undo import Undo
from hardware.worlds.junction.car import DubinsCar

_AWAY_M = 100.0  # height at which the body is hidden: above everything
_FEELER_M = 0.6  # height of the rays that test the bumper's way
_INSIDE_M = 0.3  # the rays start this far behind the bumper


class CarlaCar:
    """A car that moves as the experiment's Dubins car and is shown by a CARLA vehicle.

    The motion is computed here and not by CARLA's physics: the surrogate optimises over a Dubins car, so the deployed car must be one
    (with the flaws of its configuration), with an exactly known state. A physics vehicle would need a steering controller, whose
    errors would be mixed into the result. Physics is switched off, which also keeps the body where it is put.

    Args:
        world: A ``carla.World``.
        library: The ``carla`` module.
        undo: Receives the action that removes the body.

    Raises:
        CarlaError: The server does not have the vehicle.
        CarlaMapError: CARLA has no object label of that name.
    """

    def __init__(self, world: Any, library: Any, frame: SceneFrame, config: CarlaConfig, undo: Undo) -> None:
        self._world, self._library, self._frame, self._config, self._undo = (
            world,
            library,
            frame,
            config,
            undo,
        )
        self._solid = {_label(library, name) for name in config.body.solid}
        reach = config.junction.reach_m
        self._car = DubinsCar(config.car, lambda x, y, yaw: max(abs(x), abs(y)) <= reach)
        self._actor: Any = None
        self._shown: CarlaPose | None = None
        self._hit = False

    @property
    def state(self) -> VehicleState:
        """True pose and speed."""
        return self._car.state

    @property
    def blocked(self) -> bool:
        """Whether the car stands against something solid or at the end of the world."""
        return self._hit or self._car.blocked

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest."""
        self._hit = False
        state = self._car.reset(x_m, y_m, yaw_rad)
        self.show()
        return state

    def advance(self, turn_rate_radps: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Hold one command for a while; the car does not move if something solid blocks it."""
        before = self._car.state
        after = self._car.advance(turn_rate_radps, speed_mps, duration_s)
        self._hit = self._runs_into_something(before, after)
        if self._hit:
            after = self._car.reset(before.x_m, before.y_m, before.yaw_rad)
        self.show()
        return after

    def show(self) -> None:
        """Put the body where the car is."""
        if self._config.body.blueprint is None:
            return
        ahead = planar_pose(self._config.body.origin_ahead_m, 0.0, 0.0)
        self._put(self._frame.body_pose(self._car.state.T_world_from_car @ ahead))

    def hide(self) -> bool:
        """Take the body out of sight, for pictures of the scene without it; False if it was not spawned yet."""
        if self._actor is None:
            return False
        away = planar_pose(0.0, 0.0, 0.0)
        away[2, 3] = _AWAY_M
        self._put(self._frame.body_pose(away))
        return True

    def _put(self, pose: CarlaPose) -> None:
        if self._actor is None:
            self._spawn()
        if pose != self._shown:
            self._actor.set_transform(pose.to_transform(self._library))
            self._shown = pose

    def _spawn(self) -> None:
        """Spawn the body in the air, where nothing is in the way, with physics off so that it does not fall."""
        name = self._config.body.blueprint
        away = planar_pose(0.0, 0.0, 0.0)
        away[2, 3] = _AWAY_M
        try:
            blueprint = self._world.get_blueprint_library().find(name)
            self._actor = self._world.spawn_actor(
                blueprint, self._frame.body_pose(away).to_transform(self._library)
            )
        except (RuntimeError, IndexError) as error:
            raise CarlaError(
                f"expected to put the vehicle {name} into CARLA's world, got: {error}; name another one in body.blueprint, or null for "
                "cameras without a body"
            ) from error
        self._undo.push("removing the car", self._actor.destroy)
        self._actor.set_simulate_physics(False)

    def _runs_into_something(self, before: VehicleState, after: VehicleState) -> bool:
        """Whether the front bumper passed something solid on its way (``World.cast_ray`` from its old to its new place)."""
        if not self._solid or (before.x_m, before.y_m) == (after.x_m, after.y_m):
            return False
        starts, ends = self._bumper(before, -_INSIDE_M), self._bumper(after, 0.0)
        for start, end in zip(starts, ends, strict=True):
            hits = self._world.cast_ray(
                *(self._library.Location(*self._frame.carla_point(at)) for at in (start, end))
            )
            if any(hit.label in self._solid for hit in hits):
                return True
        return False

    def _bumper(self, state: VehicleState, ahead_m: float) -> Array:
        body = self._config.body
        front = body.origin_ahead_m + body.half_length_m + ahead_m
        points = [[front, side * body.half_width_m, _FEELER_M] for side in (-1.0, 0.0, 1.0)]
        return transform_points(state.T_world_from_car, points)


def _label(library: Any, name: str) -> Any:
    names = library.CityObjectLabel.names
    if name not in names:
        raise CarlaMapError(f"expected body.solid of {', '.join(sorted(names))}, got {name!r}")
    return names[name]
