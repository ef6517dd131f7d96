"""What all stages of the intersection's experiment share: the resolved configuration, the world, paths, camera, car."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
import torch

from advnerf_core.driving.dynamics import Dubins
from advnerf_core.driving.expert import Expert, ExpertConfig
from advnerf_core.driving.metrics import Horizon
from advnerf_core.driving.path import Arc, Line, Path
from advnerf_core.geometry import Array, Pinhole
from advnerf_core.policies.view import PolicyView
from hardware.worlds.carla.config import CarlaConfig
from hardware.worlds.junction.config import IntersectionConfig
from hardware.worlds.junction.paths import ReferencePath
from nodes.experiment.junction.config import IntersectionExperimentConfig
from nodes.experiment.junction.site import CarlaSite, Site, TwinSite, World
from nodes.experiment.run_folder import RunFolder


@dataclass(frozen=True)
class Experiment(RunFolder[IntersectionExperimentConfig]):
    """One resolved experiment."""

    @cached_property
    def site(self) -> Site:
        """Where it is captured and deployed, with the experiment's changes."""
        if self.config.kind == "carla":
            return CarlaSite(CarlaConfig.model_validate(self.config.world), self.stage_folder("capture"))
        return TwinSite(IntersectionConfig.model_validate(self.config.world))

    @property
    def world(self) -> World:
        """The site's configuration: cameras, car, objects."""
        return self.site.world

    @cached_property
    def references(self) -> dict[str, ReferencePath]:
        """The drives of the experiment by scenario."""
        known = self.site.references
        return {name: known[name] for name in self.config.scenarios}

    @cached_property
    def paths(self) -> dict[str, Path]:
        """Reference paths by scenario."""
        return {name: as_path(reference) for name, reference in self.references.items()}

    def goal(self, scenario: str) -> tuple[float, ...]:
        """The exit as the policy is told it, one-hot."""
        return self.references[scenario].goal

    def expert(self, scenario: str) -> Expert:
        """The teacher on one path; its output is a turn rate [rad/s]."""
        wanted, bound = self.config.policy, self.world.car.max_turn_rate_radps
        config = ExpertConfig(
            speed_mps=self.world.car.speed_mps, delay_s=wanted.delay_s, stiffness_1pm=wanted.stiffness_1pm,
            feed_forward=wanted.feed_forward, smoothing_m=self.world.car.speed_mps * self.config.dt_s,
            steering_limits_rad=(-bound, bound), output="turn_rate",
        )  # fmt: skip
        return Expert(self.paths[scenario], config)

    @property
    def mount(self) -> Array:
        """Driving camera on the car ``[4, 4]``."""
        return self.world.camera.T_car_from_camera

    @property
    def camera(self) -> Pinhole:
        """Intrinsics of the driving camera."""
        return self.world.camera.pinhole

    @cached_property
    def view(self) -> PolicyView:
        """What the policy sees of the driving camera."""
        return PolicyView(self.camera)

    @cached_property
    def dynamics(self) -> Dubins:
        """The surrogate's car, without the lag and the gain error of the deployed one."""
        return Dubins(self.world.car.speed_mps, self.config.dt_s)

    @property
    def limits(self) -> Horizon:
        """Over how many ticks a drive is measured, and what counts as off the track."""
        return Horizon(self.config.horizon, self.config.dt_s, self.site.off_track_m, self.config.held_cap_m)

    def start_states(self, scenario: str, seed: int) -> torch.Tensor:
        """Start poses ``[B, 3]`` float64 of one attack, drawn about the nominal one; the first of seed 0 is the nominal one itself.

        A seed that changed only the search's first noise would repeat one drive: gradients end in the same colours from everywhere.
        """
        wanted, nominal = self.config.attack, self.references[scenario].start_pose
        noise = np.random.default_rng([seed, self.config.scenarios.index(scenario)]).standard_normal((wanted.starts, 3))
        if seed == 0:
            noise[0] = 0.0
        # A tenth of a radian at the start would be 2.4 m of error at the junction.
        spread = wanted.start_sigma * np.array([1.0, 1.0, 0.25])
        return torch.from_numpy(np.array(nominal) + spread * noise)


def as_path(reference: ReferencePath) -> Path:
    """The path that lines and arcs describe; open at both ends."""
    pieces = [Line(piece[1]) if piece[0] == "line" else Arc(piece[1], piece[2]) for piece in reference.segments]
    return Path.from_segments(reference.start_pose, pieces, closed=False)
