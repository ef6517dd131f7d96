"""A policy of your own as the victim of an experiment, `my_policy.experiment.yaml`: nothing is trained.

    .venv/bin/advnerf experiment examples/my_policy.experiment.yaml --setting quick --run-folder runs/my_policy

This one follows the green tape of the simulated room by its place in the picture; put your network and its weights in its place.
"""

import torch

from advnerf_core import PolicyContract, PolicyView, adapt
from calibration.schema import CameraCalibration, load_calibration
from nodes.runtime.paths import shipped


class FollowsTheTape(torch.nn.Module):
    """Steers to where the lower half of the picture is green."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Steering [rad], left positive, of images ``[B, 3, 40, 120]``."""
        lower = images[:, :, 20:]
        green = torch.relu(lower[:, 1] - 0.6 * (lower[:, 0] + lower[:, 2]) - 0.05).sum(dim=1) + 1e-3
        side = torch.linspace(1.0, -1.0, green.shape[1])
        return 0.35 * torch.tanh(2.0 * (green * side).sum(dim=1) / green.sum(dim=1))


def factory() -> object:
    """What experiments call: the network in eval mode, and what it takes and gives."""
    camera = load_calibration(CameraCalibration, shipped("calibration/twin") / "camera.yaml")
    view = PolicyView(camera.pinhole, crop_top_px=60, crop_height_px=112, width=120, height=40)
    return adapt(FollowsTheTape().eval(), PolicyContract(view))
