"""CARLA's world in synchronous mode; its settings are restored afterwards."""

from __future__ import annotations

from typing import Any

from hardware.worlds.carla.config import RenderConfig
from hardware.worlds.carla.errors import CarlaMapError
from hardware.worlds.carla.library import server_answers
from hardware.worlds.carla.undo import Undo


class TickedWorld:
    """Synchronous mode with a fixed time step.

    Args:
        world: A ``carla.World``.
        fixed_delta_s: Simulated time of one tick [s].
        timeout_s: Limit for one tick [s].
        undo: Receives the action that restores the world's settings, before they are changed.

    Attributes:
        frame: Number of the last tick; -1 before the first.
    """

    def __init__(self, world: Any, fixed_delta_s: float, timeout_s: float, undo: Undo) -> None:
        self.world, self.fixed_delta_s, self._timeout_s = world, fixed_delta_s, timeout_s
        self.frame = -1
        before, ours = world.get_settings(), world.get_settings()
        # A world that was already synchronous (`take_over`) has no other client that ticks it: it would stand still for ever.
        before.synchronous_mode = False
        undo.push("the world's settings", lambda: world.apply_settings(before))
        ours.synchronous_mode, ours.fixed_delta_seconds, ours.no_rendering_mode = True, fixed_delta_s, False
        with server_answers("synchronous mode"):
            world.apply_settings(ours)

    def tick(self) -> int:
        """Advance by ``fixed_delta_s`` and return the frame number.

        Raises:
            CarlaUnreachable: The server did not finish the tick in time.
        """
        with server_answers("a tick"):
            self.frame = int(self.world.tick(self._timeout_s))
        return self.frame


def set_scenery(world: Any, library: Any, render: RenderConfig, undo: Undo) -> None:
    """Set weather and traffic lights so that the same place looks the same every time."""
    if render.weather is not None:
        wanted = weather_of(library, render.weather)
        before = world.get_weather()
        undo.push("the weather", lambda: world.set_weather(before))
        world.set_weather(wanted)
    if render.freeze_lights:
        undo.push("the traffic lights", lambda: world.freeze_all_traffic_lights(False))
        world.freeze_all_traffic_lights(True)


def weather_of(library: Any, name: str) -> Any:
    """A preset without wind, so that leaves do not move between pictures.

    Raises:
        CarlaMapError: CARLA has no preset of that name.
    """
    kinds = library.WeatherParameters
    presets = [each for each in dir(kinds) if isinstance(getattr(kinds, each), kinds)]
    if name not in presets:
        raise CarlaMapError(f"expected a weather of {', '.join(presets)}, got {name!r}")
    # A copy, because the library's presets are shared and mutable.
    preset, weather = getattr(kinds, name), kinds()
    for each in dir(preset):
        if isinstance(getattr(preset, each), float):
            setattr(weather, each, getattr(preset, each))
    weather.wind_intensity = 0.0
    return weather
