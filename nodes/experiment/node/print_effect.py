"""What a measured print does to its victim: the drive in the learned scene, with the print in the place of its attack."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from advnerf_core.attack.adjoint import evaluate
from advnerf_core.attack.artifact import AttackFile
from advnerf_core.attack.spaces.space import Shown
from advnerf_core.geometry import Array
from advnerf_core.plain import PlainData
from advnerf_core.scene.surrogate import split_theta
from nodes.experiment.node.prepare import prepare
from nodes.experiment.plan.placed import FLAT
from nodes.experiment.show.context import Experiment
from nodes.experiment.show.own_scene import flat_object
from nodes.experiment.steps.attack import Prepared, past_field
from nodes.runtime.errors import ConfigError

# The squash has no inverse at 0 and 1.
_MARGIN = 1e-3


@dataclass(frozen=True)
class PrintEffect(PlainData):
    """Mean total CTE of the request's drives [m].

    Attributes:
        clean_m: Past the plain objects.
        nominal_m: Past the attack as it was searched: its own texture, size and pose.
        print_m: Past the print as it was measured.
        at_measured_pose: Whether the print stands at its measured pose; otherwise at that of the attack.
    """

    clean_m: float
    nominal_m: float
    print_m: float
    at_measured_pose: bool

    @property
    def text(self) -> str:
        """The totals, and the share of the attack's excess that the print keeps."""
        excess = self.nominal_m - self.clean_m
        share = (
            f", {100 * (self.print_m - self.clean_m) / excess:.0f} % of its excess" if excess > 1e-3 else ""
        )
        where = "where it hangs" if self.at_measured_pose else "if it hung at the attack's pose"
        return f"predicted total CTE: without attack {self.clean_m:.2f} m, as searched {self.nominal_m:.2f} m, this print {self.print_m:.2f} m {where}{share}"


def print_effect(
    request: Experiment,
    attack: AttackFile,
    name: str,
    texture: NDArray[np.uint8],
    scale: float,
    T_world_from_face: Array | None,
) -> PrintEffect:
    """Drive past a print of an attack, as its request says.

    Args:
        name: The object whose texture it is.
        texture: The print with its border as the driving camera sees it, ``[n, n, 3]`` uint8.
        scale: Its true size with its border over the size of the attack's texture.
        T_world_from_face: Where it hangs ``[4, 4]``; None for the attack's pose.

    Raises:
        ConfigError: The request has no such panel.
        AttackFileError: The request is not that of this attack.
    """
    prepared = prepare(request, attack.seed)
    found = prepared.space.restored(attack)
    names = [thing.name for thing in request.objects]
    if name not in names or request.objects[names.index(name)].kind not in FLAT:
        raise ConfigError(f"{request.file}: expected a panel or cube named {name}, got {', '.join(names)}")
    shown = _with_print(request, attack, found, names.index(name), texture, scale, T_world_from_face)
    clean_m, nominal_m, print_m = (_total_m(prepared, each) for each in (prepared.space.plain, found, shown))
    return PrintEffect(clean_m, nominal_m, print_m, T_world_from_face is not None)


def _with_print(
    request: Experiment,
    attack: AttackFile,
    found: Shown,
    number: int,
    texture: NDArray[np.uint8],
    scale: float,
    T_world_from_face: Array | None,
) -> Shown:
    pose = attack.objects[number].T_world_from_object if T_world_from_face is None else T_world_from_face
    field = flat_object(request, request.objects[number], np.asarray(pose), len(texture))
    objects = list(found.objects)
    parts = list(split_theta(objects, found.colours))
    objects[number] = replace(field, scale=field.scale * scale)
    parts[number] = _theta(texture).to(found.colours.dtype)
    colours = parts[0] if len(parts) == 1 else torch.cat([part.reshape(-1, 3) for part in parts])
    return Shown(objects, colours)


def _theta(texture: NDArray[np.uint8]) -> Tensor:
    share = np.clip(texture.astype(np.float64) / 255.0, _MARGIN, 1.0 - _MARGIN)
    return torch.from_numpy(np.log(share / (1.0 - share)))


def _total_m(prepared: Prepared, shown: Shown) -> float:
    judged = past_field(prepared.experiment, prepared.problem.undisturbed(), prepared.space, shown)
    _, totals = evaluate(judged, shown.colours)
    return float(totals.protocol_cte_m.mean())
