"""The section ``deploy`` of an experiment: how attacks are deployed."""

from __future__ import annotations

from typing import Any, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from hardware.cameras.effects import PRESETS, Effects
from nodes.experiment.plan.numbers import Count, Positive, PositiveNumber
from nodes.lab.located import NamedContents


class DeployConfig(StrictModel):
    """Deployment of attacks. All keys but ``through``, ``starts``, ``car``, ``world`` and ``camera`` concern live nodes only."""

    through: Literal["world", "nodes", "nothing"] = Field(
        default="world",
        description="world: the world's own car, in this process; nodes: the live nodes and the simulated lab; nothing: search only.",
    )
    starts: Positive | None = Field(
        default=None,
        description="So many of the measured starts are deployed; none: all. A live drive takes half a minute.",
    )
    car: Literal["own", "ideal"] = Field(
        default="own",
        description="What drives through the world: its own car; or the surrogate's, which does what it is told and meets no obstacle.",
    )
    world: dict[str, Any] | None = Field(
        default=None,
        description="Another world of the same paths, camera and car, where attacks are deployed: another renderer, or another car behind it. none: the experiment's own.",
    )
    camera: Effects = Field(
        default=PRESETS["ideal"],
        description="What the driving camera adds to an ideal picture: ideal, webcam, zed, or the effects themselves.",
    )
    launch_file: str = Field(
        default="green_screen.launch.yaml", description="Node graph, beside the experiment file."
    )
    nodes: tuple[str, ...] = Field(
        default=("twin", "camera", "vicon", "compositor", "policy", "safety", "motor", "recorder"),
        description="Nodes that must be ready before the car moves.",
    )
    calibration: NamedContents | None = Field(
        default=None,
        description="Folder of the calibration files that live nodes use, such as measured ones; none: those of the simulated lab, which are exact but for the car's gains.",
    )
    changes: tuple[str, ...] = Field(
        default=(),
        description="Changes of the launch file, as its --set takes them, such as twin.vicon.latency_s=0.005.",
    )
    laps: Count = Field(default=0, description="Laps driven live without attack before the cells.")
    empty_scene: bool = Field(default=False, description="Also drive with the panel taken away.")
    ready_timeout_s: PositiveNumber = Field(
        default=60.0, description="Time for the graph to become ready [s]."
    )

    @model_validator(mode="after")
    def _live_cars_are_their_own(self) -> DeployConfig:
        of_a_way = {
            "world": {"deploy.car ideal": self.car == "ideal", "deploy.world": self.world is not None},
            "nodes": {
                "deploy.calibration": self.calibration is not None,
                "deploy.changes": bool(self.changes),
            },
        }
        for way, wanted in of_a_way.items():
            for what, is_wanted in wanted.items():
                if is_wanted and self.through != way:
                    raise ValueError(f"expected deploy.through {way} with {what}, got {self.through}")
        if self.through == "nothing" and not self.camera.ideal:
            raise ValueError(
                "expected deploy.through world or nodes with deploy.camera, got nothing, where no camera drives"
            )
        return self

    @property
    def live(self) -> bool:
        """Whether live nodes drive."""
        return self.through == "nodes"
