"""What all stages of one experiment share: the resolved configuration, the lab, the calibration, the path."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path as FilePath

from advnerf_core.display import DisplayModel
from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.path import Path
from advnerf_core.policies.view import PolicyView
from calibration.display_colour import DisplayCalibration
from calibration.panel import centre_square
from calibration.schema import (
    CameraCalibration,
    RoomCalibration,
    TargetCalibration,
    VehicleCalibration,
    load_calibration,
)
from hardware.worlds.lab.config import LabConfig, PanelConfig
from nodes.experiment.config import ExperimentConfig
from nodes.experiment.run_folder import RunFolder

CONTROL_PERIOD_S = 0.1
CALIBRATION = "calibration"
DISPLAY = "display"


@dataclass(frozen=True)
class Experiment(RunFolder[ExperimentConfig]):
    """One resolved experiment."""

    @cached_property
    def lab_config(self) -> LabConfig:
        """The simulated lab with the experiment's changes."""
        return LabConfig.model_validate(self.config.lab)

    @property
    def launch_file(self) -> FilePath:
        """The node graph of the live runs."""
        return self.file.parent / self.config.deploy.launch_file

    def calibration_file(self, name: str) -> FilePath:
        """A calibration file that the capture stage left: camera, vehicle, board, monitor or room."""
        return self.stage_folder("capture") / CALIBRATION / f"{name}.yaml"

    @cached_property
    def camera(self) -> CameraCalibration:
        """The driving camera."""
        return load_calibration(CameraCalibration, self.calibration_file("camera"))

    @cached_property
    def room(self) -> RoomCalibration:
        """Path, fence and start pose."""
        return load_calibration(RoomCalibration, self.calibration_file("room"))

    @cached_property
    def target(self) -> TargetCalibration:
        """The face on which an attack is shown: the board, or the monitor's centre square."""
        target = load_calibration(TargetCalibration, self.calibration_file(self.config.object.target))
        return centre_square(target) if self.shown_on_monitor else target

    @property
    def shown_on_monitor(self) -> bool:
        """Whether the face is shown on the monitor; else it is projected onto the board."""
        return self.config.object.target == "monitor"

    @property
    def panel(self) -> PanelConfig:
        """What carries the face in the lab."""
        return self.lab_config.monitor if self.shown_on_monitor else self.lab_config.board

    @property
    def face_m(self) -> float:
        """Side of the square face [m]."""
        return min(self.panel.width_m, self.panel.height_m)

    @cached_property
    def display(self) -> DisplayModel:
        """What the driving camera sees of the monitor's colours, as measured in the capture stage."""
        return load_calibration(DisplayCalibration, self.calibration_file(DISPLAY)).display

    @cached_property
    def path(self) -> Path:
        """The reference path."""
        return self.room.reference_path

    @cached_property
    def view(self) -> PolicyView:
        """What the policy sees of the driving camera."""
        return PolicyView(self.camera.pinhole, distortion=self.camera.distortion)

    @cached_property
    def dynamics(self) -> Ackermann:
        """The surrogate's car: as calibrated, without the lags and errors of the real one."""
        vehicle = load_calibration(VehicleCalibration, self.calibration_file("vehicle"))
        limits = (vehicle.limits.steering_min_rad, vehicle.limits.steering_max_rad)
        return Ackermann(vehicle.wheelbase_m, self.speed_mps, CONTROL_PERIOD_S, limits)

    @property
    def speed_mps(self) -> float:
        """Driving speed."""
        return self.lab_config.car.speed_mps
