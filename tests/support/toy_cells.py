"""Cells that cost nothing, in place of those of experiments: the processes, queues and files around them are the real ones.

A test puts the functions below over those of `nodes.experiment` (`put_over`). A process of its own, which must not import what searches need,
gets this module in place of theirs (`install`). Files in the run folder say what goes wrong: ``fail``, ``hang``, ``late``.
"""

import os
import sys
import time
from contextlib import nullcontext

from advnerf_core.run_module import module_command
from nodes.experiment.engine.run_folder import RunFolder

MODULE = "tests.support.toy_cells"
REPLACED = ("run.cells", "steps.run", "steps.keys", "steps.steering_gate", "show.context")
FACTORS = {"none": 1.0, "random": 1.1, "cem": 2.0, "gradient": 3.0}
Bench = nullcontext


class Experiment(RunFolder):
    """An experiment whose section world says what its cells find."""

    @property
    def data(self):
        return self.config.world


def load_experiment(file, setting, overrides, folder, executes=True):
    return Experiment.resolved(file, setting, overrides, folder, executes, lambda made, document: made)


def prepare_victims(experiment):
    experiment.folder.mkdir(parents=True, exist_ok=True)


def require_same_steering(experiment, may_go_on=False, say=print):
    pass


def require_searchable(experiment, cells):
    pass


def stages_needed(config, victim):
    return ["capture", "policy"]


def settings_hash(experiment, cell):
    from advnerf_core.attack.methods import method_digest
    from nodes.experiment.engine.artefact import hash_of

    _require_path(experiment, cell)
    code = method_digest(cell.code)
    return hash_of([cell.scenario, cell.victim, cell.method, cell.seed, code, experiment.data])


def registered_settings(experiment):
    from nodes.experiment.engine.artefact import Settings

    return Settings.of(**experiment.data)


def cell_settings(experiment, cell):
    _require_path(experiment, cell)
    return registered_settings(experiment)


def outdated_stages(experiment, victim):
    return []


def needed_settings(experiment):
    return {"capture": {}, "policy": {}}


def keep_build(experiment, reference):
    return []


def runs_alone(experiment):
    return "alone" in experiment.data


def has_learned_scene(experiment):
    return (experiment.folder.parent / "gated").exists()


is_predictable = has_learned_scene


def clean_folder(experiment, cell, folder):
    return folder


def search_cell(experiment, cell, folder, report, bench=None):
    _require_path(experiment, cell)
    _note(folder, f"search {folder.name}")
    (folder / "searched").touch()


def run_cell(experiment, cell, folder, report, bench=None, control_m=()):
    _require_path(experiment, cell)
    _note(folder, f"begin {folder.name} {cell.code} {os.environ.get('OMP_NUM_THREADS')}")
    run = folder.parent.parent
    if (run / "fail").exists() and cell.method == "cem":
        raise RuntimeError("the search came to nothing")
    try:
        while (run / "hang").exists() and cell.method == "gradient":
            (folder / "pid").write_text(str(os.getpid()))
            time.sleep(0.02)
    except BaseException:
        _note(folder, f"closed {folder.name}")
        raise
    _note(folder, f"end {folder.name}")
    if cell.method not in FACTORS:
        return _searched(cell)
    none = experiment.data["none_m"] + cell.seed
    drives = {
        "total_cte_m": [FACTORS[cell.method] * none],
        "off_track": [cell.method == "gradient"],
        "none_total_cte_m": [none],
    }
    found = {"attack_id": None, "surrogate": drives, "extra": {"horizon": 20}}
    if (run / "late").exists() and cell.method == "gradient":
        return {**found, "not_driven_live": "live0 was spoiled 3 times, at last: late"}
    return {**found, "deployed": {**drives, "none_total_cte_m": list(control_m) or [none]}}


def _searched(cell):
    """What a user's method really finds, over a closed loop of two ticks."""
    import torch

    from advnerf_core.attack.adjoint import evaluate
    from advnerf_core.attack.methods import SearchRun, SearchSettings, load_method
    from tests.support.attack_toy import toy_problem

    problem = toy_problem(2, dtype=torch.float32)
    plain = evaluate(problem, problem.sensor.plain_theta())[1].protocol_cte_m.tolist()
    chosen = load_method(cell.code)
    settings = SearchSettings(3, population=4, options=chosen.options({}))
    result = chosen.search(problem, settings, SearchRun(cell.seed))
    found = list(result.best.protocol_cte_m)
    drives = {"total_cte_m": found, "off_track": [False] * len(found), "none_total_cte_m": plain}
    return {"attack_id": None, "surrogate": drives, "extra": {"theta": result.theta.flatten().tolist()}}


def _require_path(experiment, cell):
    """Experiments know cells by their paths, whatever a variant calls them."""
    assert cell.scenario in experiment.config.paths, cell


def _note(folder, text):
    with open(folder.parent.parent / "calls.txt", "a") as file:
        file.write(text + "\n")


def command(module, *arguments):
    """The process of a toy cell, in place of that of a cell."""
    return module_command(MODULE, *arguments)


def put_over(monkeypatch, modules):
    """Put the functions of this module over those that modules of `nodes.experiment.run` have imported."""
    toys = {name: value for name, value in globals().items() if not name.startswith("_")}
    for module in modules:
        for name in toys.keys() & vars(module).keys() - {"annotations", "Path"}:
            if str(getattr(vars(module)[name], "__module__", "nodes.experiment")).startswith(
                "nodes.experiment"
            ):
                monkeypatch.setattr(module, name, toys[name])


def install():
    """Stand for the modules of experiments in this process, before they are imported."""
    for name in REPLACED:
        sys.modules[f"nodes.experiment.{name}"] = sys.modules[__name__]
    from nodes.experiment.run import run, worker

    worker.module_command = command
    run.run_in_process = run_on_machine


def run_on_machine(job):
    """Run a toy cell from a process of a cluster."""
    from nodes.experiment.run import worker

    worker.module_command = command
    return worker.run_in_process(job)


if __name__ == "__main__":
    install()
    from nodes.experiment.run import worker

    worker.main()
