"""The space of a face: one flat texture on a board or a screen, alone or behind a measured display."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from advnerf_core.attack.artifact import COLOURS, AttackedObject, AttackFile
from advnerf_core.attack.methods import SearchRun, SearchSettings, load_method
from advnerf_core.attack.problem import AttackProblem
from advnerf_core.attack.search.record import SearchResult
from advnerf_core.attack.spaces.displayed import DisplayedSensor
from advnerf_core.attack.spaces.space import FaceMount, NamedObject, Shown, require_same
from advnerf_core.display import DisplayModel
from advnerf_core.scene.surrogate import Surrogate


class FaceSpace:
    """Colours of a face that hides its panel; without an attack the learned panel is seen.

    Args:
        surrogate: The scene with the face as its only object.
        named: Entries of the face in attack files.
        display: Optics of the screen and the room; None for a board, or for a screen that is assumed ideal.
        cos_angle: Cosine of the angle at which the camera looks at a screen; see `DisplayedSensor`.
    """

    name = COLOURS

    def __init__(
        self,
        surrogate: Surrogate,
        named: NamedObject,
        mount: FaceMount,
        display: DisplayModel | None = None,
        cos_angle: float = 1.0,
    ) -> None:
        if len(surrogate.objects) != 1:
            raise ValueError(f"expected a surrogate with one face, got {len(surrogate.objects)} objects")
        self.surrogate, self.mount, self._named = surrogate, mount, named
        self.sensor: Surrogate | DisplayedSensor = surrogate
        if display is not None:
            self.sensor = DisplayedSensor(surrogate, display, cos_angle)

    @property
    def plain(self) -> Shown:
        """The learned scene without the face."""
        return Shown((), torch.zeros(0, 3, dtype=self.surrogate.dtype))

    def search(
        self, method: str, problem: AttackProblem, settings: SearchSettings, run: SearchRun
    ) -> SearchResult:
        """Search with any method; see `Space.search`."""
        return load_method(method).search(problem, settings, run)

    def attacked(self, theta: Tensor) -> tuple[AttackedObject, ...]:
        """The shown colours."""
        (field,) = self.surrogate.objects
        colours = theta.detach().numpy().astype(np.float32)
        return (
            AttackedObject(
                self._named.name, colours, field.T_world_from_object, field.scale, self._named.sha256
            ),
        )

    def restored(self, attack: AttackFile) -> Shown:
        """The face in the seen colours, behind the display if there is one; see `Space.restored`."""
        require_same(attack, [self._named])
        shown = torch.from_numpy(np.array(attack.face_object.theta)).to(self.surrogate.dtype)
        seen = self.sensor.seen_theta(shown) if isinstance(self.sensor, DisplayedSensor) else shown
        return Shown(self.surrogate.objects, seen.detach())
