"""A policy of your own as the victim of an experiment, `my_policy.experiment.yaml`: nothing is trained.

    .venv/bin/advnerf experiment run examples/my_policy.experiment.yaml --setting quick --folder runs/my_policy

This one steers to where the picture is green, as the tape of the simulated room is; put your network and its weights in its place.
"""

import torch

from advnerf_core import PolicyContract, PolicyView, adapt
from calibration.schema import CameraCalibration, load_calibration
from nodes.runtime.paths import shipped


class FollowsTheTape(torch.nn.Module):
    """Steers to the mean place of what is green; near rows count more."""

    def forward(self, images: torch.Tensor) -> torch.Tensor:
        """Steering [rad], left positive, of images ``[B, 3, 48, 140]``."""
        red, green, blue = images.unbind(dim=1)
        greenness = torch.nn.functional.softplus(30.0 * (green - 0.6 * (red + blue) - 0.1))
        rows, columns = greenness.shape[1:]
        weight = greenness * torch.linspace(0.3, 1.0, rows)[:, None]
        side = torch.linspace(1.0, -1.0, columns)
        return 0.35 * torch.tanh(2.0 * (weight * side).sum(dim=(1, 2)) / weight.sum(dim=(1, 2)))


def factory() -> object:
    """What experiments call: the network in eval mode, and what it takes and gives."""
    camera = load_calibration(CameraCalibration, shipped("calibration/twin") / "camera.yaml")
    view = PolicyView(camera.pinhole, crop_top_px=50, crop_height_px=115, width=140, height=48)
    return adapt(FollowsTheTape().eval(), PolicyContract(view))
