"""The request that is shipped says what the experiment does."""

from pathlib import Path

import numpy as np

from hardware.twin.config import LabConfig
from nodes.attacking.request import load_request
from nodes.experiment.objects import FACE_OFFSET_M

EXAMPLE = Path(__file__).parents[3] / "launch" / "corner.attack.yaml"


def test_the_shipped_request_attacks_the_board_where_it_stands():
    request = load_request(EXAMPLE, [])
    assert (request.horizon, request.search.method) == (40, "gradient")
    (face,) = request.objects
    in_front = LabConfig().board.T_world_from_face.copy()
    in_front[:3, 3] += FACE_OFFSET_M * in_front[:3, 0]
    np.testing.assert_allclose(face.pose, in_front, atol=2e-4)
