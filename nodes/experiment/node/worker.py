"""The search of the attack node, in a separate process: ``python -m nodes.experiment.node.worker FOLDER``.

It reads the request in the folder, resumes from a state if it exists, and writes to the node on its standard output: lines
of JSON, and an image's pixels after the line that announces it. All other output is redirected to standard error.
"""

from __future__ import annotations

import json
import os
import sys
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.attack.artifact import face_texture, load_attack
from advnerf_core.attack.search.record import Evaluation
from advnerf_core.attack.search.search import evaluation_from_json
from advnerf_core.code_files import was_raised_by_a_user
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import read_tensors
from advnerf_core.plugins import exit_refused, in_one_line, name_in_results
from advnerf_core.policies.network import tensor_to_images
from nodes.experiment.node.job import TOGETHER_STATE
from nodes.experiment.node.search import kept_request, planned_evaluations, run_attack
from nodes.experiment.steps.attack import Prepared
from nodes.runtime.progress import MeasuringReport

TEXTURE, PREVIEW = "texture", "preview"
_PREVIEW_SCALE = 2


class Speaker:
    """Reports to the node, in the place of a command's display."""

    def __init__(self, stream: BinaryIO, folder: Path) -> None:
        self._stream, self._folder, self._evaluations = stream, folder, 0
        self._prepared: Prepared | None = None
        self._best: Evaluation | None = None

    def say(self, kind: str, pixels: bytes = b"", **data: Any) -> None:
        """Write one line, and the pixels that follow it."""
        self._stream.write(json.dumps({"kind": kind, "bytes": len(pixels), **data}).encode() + b"\n" + pixels)
        self._stream.flush()

    def start(self, stage: str) -> MeasuringReport:
        """A seed begins; evaluations report its progress."""
        del stage
        return lambda fraction, text="", point=None: None

    def finish(self, stage: str, seconds: float, cached: bool) -> None:
        """A seed has ended, which is reported with its file."""

    def prepared(self, prepared: Prepared) -> None:
        """A seed is ready to be searched."""
        done, self._best = _so_far(self._state(prepared))
        self._prepared, self._evaluations = prepared, planned_evaluations(prepared)
        self.say(
            "progress",
            state="searching",
            seed=prepared.seed,
            evaluation=done,
            evaluations=self._evaluations,
            text="",
            total_cte_m=0.0 if self._best is None else self._best.predicted_total_cte_m,
            clean_total_cte_m=prepared.clean_drive.mean_total_cte_m,
            clean_drives=prepared.clean_drive.drives,
            objective=name_in_results(prepared.experiment.config.attack.objective),
            unit=prepared.problem.objective.unit,
            clean_value=prepared.clean_value,
            value=None if self._best is None else self._best.value,
        )

    def told(self, evaluation: Evaluation) -> None:
        """An evaluation is finished and its state is on disk."""
        assert self._prepared is not None
        better = self._best is None or evaluation.value > self._best.value
        self._best = evaluation if better else self._best
        self.say(
            "progress",
            state="searching",
            seed=self._prepared.seed,
            evaluation=evaluation.iteration + 1,
            text="",
            evaluations=self._evaluations,
            loss_m=evaluation.loss_m,
            total_cte_m=evaluation.predicted_total_cte_m,
            value=evaluation.value,
            seconds=evaluation.seconds,
        )
        if better:
            self._show(self._prepared)

    def _show(self, prepared: Prepared) -> None:
        """The best texture, and the policy's view of it from the first start."""
        theta = self._best_theta(prepared)
        if theta is None:  # the method writes no state
            return
        texture = _texture(prepared, theta)
        if texture is not None:
            self._image(TEXTURE, texture)
        seen = prepared.problem.sensor.sense(prepared.problem.start_states[:1], theta).images
        pixels = tensor_to_images(seen)[0]
        self._image(PREVIEW, pixels.repeat(_PREVIEW_SCALE, 0).repeat(_PREVIEW_SCALE, 1))

    def _best_theta(self, prepared: Prepared) -> Tensor | None:
        """Best theta of the current seed; of the best seed if all are searched together; None without a state file."""
        together = prepared.experiment.config.attack.together
        state = self._folder / TOGETHER_STATE if together else self._state(prepared)
        if not state.exists():
            return None
        header, tensors = read_tensors(state, "torch", ["best_theta"])
        best: Tensor = tensors["best_theta"]
        if not together:
            return best
        histories = json.loads(header.get("histories", "[]"))
        values = [max(evaluation_from_json(entry).value for entry in history) for history in histories]
        return best[values.index(max(values))]

    def _state(self, prepared: Prepared) -> Path:
        return self._folder / f"seed_{prepared.seed}.state.safetensors"

    def _image(self, name: str, pixels: NDArray[np.uint8]) -> None:
        height, width = pixels.shape[:2]
        self.say("image", np.ascontiguousarray(pixels).tobytes(), name=name, height=height, width=width)


def _so_far(state: Path) -> tuple[int, Evaluation | None]:
    """Number of evaluations of an interrupted search, and the best of them."""
    if not state.exists():
        return 0, None
    entries = json.loads(read_tensors(state, "torch", ())[0].get("history", "[]"))
    history = [evaluation_from_json(entry) for entry in entries]
    return len(history), max(history, key=lambda each: each.value, default=None)


def _texture(prepared: Prepared, theta: Tensor) -> NDArray[np.uint8] | None:
    mount = prepared.space.mount
    if mount is None:
        return None
    return face_texture(prepared.space.attacked(theta)[mount.number].theta, 256)


def work(folder: Path, stream: BinaryIO) -> None:
    """Search as the folder's request asks, and report the best file."""
    request = kept_request(folder)
    speaker = Speaker(stream, folder)
    files = run_attack(request, folder, speaker, speaker.told, speaker.prepared)
    attacks = [load_attack(file) for file in files]
    best = max(range(len(files)), key=lambda k: attacks[k].value or 0.0)
    found = attacks[best]
    speaker.say(
        "done",
        file=str(files[best]),
        attack_id=found.attack_id,
        total_cte_m=found.predicted_total_cte_m or 0.0,
    )


def main() -> int:
    """Run the worker; an error that the user can correct is one line on standard error."""
    # Never closed: the node takes the end of this pipe for the end of the process, whose shutdown takes seconds on a busy machine.
    stream = os.fdopen(os.dup(1), "wb", closefd=False)
    os.dup2(2, 1)
    try:
        with exit_refused():
            work(Path(sys.argv[1]), stream)
    except AdvnerfError as error:
        print(" ".join(str(error).split()), file=sys.stderr, flush=True)
        return 1
    except Exception as error:
        if not was_raised_by_a_user(error):
            raise
        print(f"your code has failed: {in_one_line(error)}", file=sys.stderr, flush=True)
        return 1
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
