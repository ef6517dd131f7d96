"""Experiments of run folders, which benchmarks measure again."""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.run_module import search_folder_last
from nodes.experiment.plan.config import ExperimentConfig
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.given import given_in


def experiment_in(folder: Path) -> Experiment:
    """The experiment of a run folder, as its manifest resolved it."""
    manifest = read_json(folder / "manifest.json")
    context = {"folder": Path(manifest["file"]).parent}
    search_folder_last(str(context["folder"]))  # may contain package.module:factory
    stored = manifest["config"]
    config = ExperimentConfig.model_validate(stored, context=context)
    if given_in(config):  # these say what they see; a manifest has every section
        stored = {name: section for name, section in stored.items() if name != "view"}
        config = ExperimentConfig.model_validate(stored, context=context)
    return Experiment(config, Path(manifest["file"]), folder, manifest["setting"]).with_given_scene()
