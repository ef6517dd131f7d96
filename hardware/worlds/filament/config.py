"""Settings that the lab's other renderer adds to the lab's."""

from __future__ import annotations

from pydantic import Field, field_validator

from advnerf_core.strict import StrictModel
from hardware.worlds.lab.config import CameraConfig, LabConfig, MonitorOpticsConfig, PhoneConfig
from hardware.worlds.remote_world import ServerDeadlines


class FilamentConfig(StrictModel):
    """The whole world.

    Attributes:
        lab: The room, its cameras and its car, as in the world ``lab``.
        brightness: Factor on the light that MuJoCo 4 puts into a scene whose lights have no intensities; with 4 the floor is as bright as the lab's.
        ambient_occlusion: Whether Filament darkens corners. The effect is computed in screen space, so a place changes with the viewpoint.
        server: Deadlines of its process.
    """

    lab: LabConfig = LabConfig()
    brightness: float = Field(default=4.0, gt=0.0, le=20.0)
    ambient_occlusion: bool = False
    server: ServerDeadlines = Field(default=ServerDeadlines(), exclude=True)

    @field_validator("lab")
    @classmethod
    def _plain_screen(cls, lab: LabConfig) -> LabConfig:
        if lab.monitor_optics != MonitorOpticsConfig():
            raise ValueError(
                "expected no monitor_optics, which the twin computes into its textures: here the monitor is a surface that Filament lights; "
                "leave the section out"
            )
        return lab

    @property
    def camera(self) -> CameraConfig:
        """Driving camera."""
        return self.lab.camera

    @property
    def photo(self) -> PhoneConfig:
        """Camera that photographs the room."""
        return self.lab.phone
