"""Common context of all stages of an experiment in a world: the resolved configuration, the world, paths, camera, car, objects."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path as FilePath
from typing import Any

import torch

from advnerf_core.attack.search.search import draw_start_states
from advnerf_core.documents import read_json
from advnerf_core.driving.actuated import ActuatedAckermann
from advnerf_core.driving.dynamics import Ackermann, Dubins, Dynamics
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Path
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.plugins import unknown
from advnerf_core.policies.view import PolicyView
from advnerf_core.run_module import search_folder_last
from hardware.worlds.paths import ReferencePath
from hardware.worlds.world import CarDescription
from nodes.experiment.engine.run_folder import CELLS
from nodes.experiment.plan.cell import Cell
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.plan.placed import PlacedObject, in_a_lane
from nodes.experiment.plan.sections import ResponseConfig
from nodes.experiment.show.experiment_world import ExperimentWorld
from nodes.experiment.show.given import GivenPolicy, given_in, given_victim, last_seen
from nodes.lab.policy_camera import require_camera, same_camera
from nodes.lab.policy_data.frames import OWN_VIEW, view_for_camera
from nodes.lab.worlds.expert_drive import as_path, expert_of
from nodes.launching.launch_file import load_launch
from nodes.runtime.errors import ConfigError

# A driving camera whose size differs from the default view's by more than this factor needs a view of its own.
_OTHER_SIZE = 1.25
PLACED, CALIBRATION = "objects.json", "calibration"
# Distances in stages were chosen for half a lane of this width [m] and for this speed [m/s]: the simulated junction's.
_HALF_LANE_M, _SPEED_MPS = 1.75, 6.0


@dataclass(frozen=True)
class Experiment(ExperimentWorld):
    """One resolved experiment in a world, or one of its variants.

    Attributes:
        kept: Digests of its stages' outputs when it was loaded, from the run folder, else from the ones stored with the code.
        given_scene: The learned scene of the user's own, if that is the place; no stage is run then.
    """

    kept: Mapping[str, str] = field(default_factory=dict)
    given_scene: FilePath | None = None

    @classmethod
    def resolved_in(cls, folder: FilePath) -> Experiment:
        """The experiment of a run folder, as its manifest resolved it."""
        manifest = read_json(folder / "manifest.json")
        context = {"folder": FilePath(manifest["file"]).parent}
        search_folder_last(str(context["folder"]))  # may contain package.module:factory
        stored = manifest["config"]
        config = ExperimentConfig.model_validate(stored, context=context)
        if given_in(config):  # these say what they see; a manifest has every section
            stored = {name: section for name, section in stored.items() if name != "view"}
            config = ExperimentConfig.model_validate(stored, context=context)
        return cls(config, FilePath(manifest["file"]), folder, manifest["setting"]).with_given_scene()

    def with_given_scene(self) -> Experiment:
        """The same, which knows the learned scene of the user's own if that is the place."""
        return replace(self, given_scene=self.named_world.config.file) if self.config.own_scene else self

    @property
    def view_settings(self) -> dict[str, Any]:
        """Settings of the policy's view that results depend on, as JSON data.

        Of existing policies it is the view that was last seen, so that one that was changed since does not leave the others' results unknown.
        """
        for name in given_in(self.config):
            return self._declared_view(name, last_seen(self, name)).to_dict()
        return self.config.view.model_dump(mode="json")

    @cached_property
    def references(self) -> dict[str, ReferencePath]:
        """The paths of the experiment by scenario.

        Raises:
            ConfigError: The world has no such path.
        """
        known = self.world.paths
        for name in self.config.paths:
            if name not in known:
                raise ConfigError(f"{self.file}: paths: {unknown(name, 'path', known)}")
        return {name: known[name] for name in self.config.paths}

    @cached_property
    def paths(self) -> dict[str, Path]:
        """Reference paths by scenario.

        Raises:
            ConfigError: The world's lines and arcs are invalid, such as a closed path that does not close.
        """
        try:
            return {name: as_path(reference) for name, reference in self.references.items()}
        except ValueError as error:
            raise ConfigError(f"world {self.named_world.kind}: {error}") from error

    @cached_property
    def objects(self) -> tuple[PlacedObject, ...]:
        """The objects of the attack, beside the lanes. The capture stage determines the places of those with a rule.

        Raises:
            ConfigError: An object stands in a lane, or has a rule and nothing is captured yet.
        """
        objects = self._objects_by_rule() if self.has_rules else self.placed_by_hand
        # Nothing meets what stands in a learned scene alone.
        if self.given_scene is None and (found := in_a_lane(objects, self.world)) is not None:
            raise ConfigError(f"{self.file}: objects.{found[0]}: {found[1]}")
        return objects

    @property
    def placed_by_hand(self) -> tuple[PlacedObject, ...]:
        """The objects with places in the file."""
        return tuple(each for each in self.config.objects if isinstance(each, PlacedObject))

    @property
    def has_rules(self) -> bool:
        """Whether a rule places an object."""
        return len(self.placed_by_hand) < len(self.config.objects)

    def _objects_by_rule(self) -> tuple[PlacedObject, ...]:
        file = self.stage_folder("capture") / PLACED
        if not file.exists():
            raise ConfigError(
                f"expected {file}, where the capture stage writes the places of objects with a rule; run that stage first"
            )
        return tuple(map(PlacedObject.model_validate, read_json(file)))

    def goal(self, scenario: str) -> tuple[float, ...]:
        """Goal vector of a policy on a path; empty without a goal."""
        return self.references[scenario].goal

    def expert(self, scenario: str, least_stiffness_1pm: float = 0.0) -> Expert:
        """The teacher on one path, at least so firm; its output is the car's control: turn rate [rad/s] or wheel angle [rad]."""
        wanted, car = self.config.policy, self.car
        gains = ExpertConfig(
            delay_s=wanted.delay_s,
            stiffness_1pm=max(wanted.stiffness_1pm, least_stiffness_1pm),
            feed_forward=wanted.feed_forward,
            smoothing_m=wanted.smoothing_m or car.speed_mps * self.config.dt_s,
        )
        return expert_of(self.paths[scenario], car, gains)

    @property
    def car(self) -> CarDescription:
        """The car as the surrogate models it."""
        return self.world.car

    @property
    def mount(self) -> Array:
        """Pose ``[4, 4]`` of the driving camera on the car."""
        return self.world.T_car_from_camera

    @property
    def camera(self) -> Pinhole:
        """Intrinsics of the driving camera."""
        return self.world.camera

    @cached_property
    def view(self) -> PolicyView:
        """The policy's view of the driving camera: from the section view, or from the declarations of existing policies.

        Raises:
            ConfigError: The window leaves the camera's image, or is the default and the camera has another size; or a policy was made
                for another camera, or was not loaded yet.
        """
        for name in given_in(self.config):
            return self._declared_view(name, given_victim(self, name))
        if "view" not in self.config.model_fields_set:
            self._require_usual_size()
        try:
            return PolicyView(self.camera, **self.config.view.model_dump())
        except ValueError as error:
            raise ConfigError(
                f"{self.file}: view: {error}; give the section view the window of the camera's image that is kept"
            ) from error

    def _declared_view(self, name: str, policy: GivenPolicy) -> PolicyView:
        """The view of an existing policy, which fits the driving camera."""
        view = policy.declared.view
        if "view" in self.config.model_fields_set:
            raise ConfigError(
                f"{self.file}: expected no section view with victims.{name}, whose declaration says what it sees; remove the section"
            )
        # A calibrated camera may have distortion, which the policy takes out of its pictures; worlds have none.
        if self.given_scene is not None:
            require_camera(view, self.camera, policy.policy, f"{self.file}: world.camera")
        elif not same_camera(view.camera, self.camera) or any(view.distortion):
            raise ConfigError(
                f"{self.file}: victims.{name}: expected a policy that was trained for the driving camera, {self.camera} without distortion, "
                f"got {view.camera}{' with distortion' * any(view.distortion)}; correct its declaration, or the world's camera"
            )
        return view

    def _require_usual_size(self) -> None:
        usual = OWN_VIEW.camera
        sizes = ((self.camera.width, usual.width), (self.camera.height, usual.height))
        if all(1 / _OTHER_SIZE < px / usual_px < _OTHER_SIZE for px, usual_px in sizes):
            return
        alike = view_for_camera(self.camera)
        raise ConfigError(
            f"{self.file}: expected a section view for a driving camera of {self.camera.width} x {self.camera.height}, because the default window fits "
            f"{usual.width} x {usual.height}; the same part of the image is 'view: {{crop_top_px: {alike.crop_top_px}, "
            f"crop_height_px: {alike.crop_height_px}}}'"
        )

    @cached_property
    def dynamics(self) -> Dubins | Ackermann:
        """The surrogate's car, without the lag and the gain error of the deployed one."""
        car, dt_s = self.car, self.config.dt_s
        if car.wheelbase_m is None:
            return Dubins(car.speed_mps, dt_s)
        return Ackermann(car.wheelbase_m, car.speed_mps, dt_s, car.control_limits)

    @property
    def searched_dynamics(self) -> Dynamics:
        """The same, behind the delay, lag and slew limit that searches shall reckon with.

        Raises:
            ConfigError: The car has no wheels that steer.
        """
        wanted, car = self.config.attack.response, self.dynamics
        if wanted == ResponseConfig():
            return car
        if not isinstance(car, Ackermann):
            raise ConfigError(
                f"{self.file}: expected a car with wheels that steer with attack.response, got one that turns by {self.car.control_unit}; "
                "remove the section"
            )
        limits = car.steering_limits_rad
        return ActuatedAckermann(
            car.wheelbase_m, car.speed_mps, car.dt_s, **wanted.model_dump(), steering_limits_rad=limits
        )

    @property
    def limits(self) -> Horizon:
        """Ticks of a measured drive, and its off-track limit."""
        return Horizon(self.config.horizon, self.config.dt_s, self.world.off_track_m, self.config.held_cap_m)

    @property
    def searched_ticks(self) -> int:
        """Number of ticks over which attacks are optimised."""
        return self.config.attack.horizon or self.config.horizon

    @property
    def launch_file(self) -> FilePath:
        """The node graph of live drives."""
        return self.file.parent / self.config.deploy.launch_file

    @property
    def graph(self) -> dict[str, Any]:
        """The resolved node graph of live drives, the same on every machine, wherever it is installed.

        Read each time, as the nodes read it: a launch file changed during a run does not keep the keys of the old one.

        Raises:
            ConfigError: There is no such launch file, or it is wrong.
        """
        return load_launch(self.launch_file, twin_calibration="calibration/twin").resolved

    def cell_folder(self, cell: Cell) -> FilePath:
        """Folder in which this experiment itself runs a cell."""
        return self.folder / CELLS / cell.name

    def cell_result(self, cell: Cell) -> FilePath:
        """File of a cell's result that this experiment itself has run."""
        return self.folder / CELLS / f"{cell.name}.json"

    @property
    def calibration_folder(self) -> FilePath:
        """Folder of calibration files that the capture stage wrote for the live nodes, and for a screen."""
        return self.stage_folder("capture") / CALIBRATION

    def across_m(self, length_m: float) -> float:
        """A lateral distance [m] that was chosen for half a lane of 1.75 m, scaled to this world's lanes."""
        return length_m * (self.world.off_track_m / _HALF_LANE_M)

    def along_m(self, length_m: float) -> float:
        """A distance along a path [m] that was chosen for 6 m/s, scaled to this car's speed."""
        return length_m * (self.car.speed_mps / _SPEED_MPS)

    def start_states(self, scenario: str, seed: int) -> torch.Tensor:
        """Start poses ``[B, 3]`` float64 of one attack, drawn around the nominal one; the first of seed 0 is the nominal one itself.

        They differ from `measured_starts`.
        """
        wanted = self.config.attack
        if wanted.start_poses:
            return torch.tensor(wanted.start_poses, dtype=torch.float64)
        first = seed == 0 or wanted.nominal_start
        return self._starts(scenario, wanted.starts, seed, nominal_first=first)

    def measured_starts(self, scenario: str) -> torch.Tensor:
        """Start poses ``[M, 3]`` float64 from which all methods and seeds are measured, around the nominal one; no search uses them."""
        wanted = self.config.measure
        return self._starts(scenario, wanted.starts, wanted.seed, nominal_first=False)

    def _starts(self, path: str, count: int, seed: int, nominal_first: bool) -> torch.Tensor:
        number, sigma = self.config.paths.index(path), self.config.attack.start_sigma
        return draw_start_states(self.references[path].drive_start, count, sigma, seed, number, nominal_first)
