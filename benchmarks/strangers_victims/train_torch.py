"""A steering network in plain PyTorch, as somebody trains one who has never heard of this project: ``python train_torch.py DATA.npz POLICY.onnx``."""

import sys

import numpy as np
import torch
from torch import nn

data = np.load(sys.argv[1])
torch.manual_seed(0)
images = torch.from_numpy(data["images"]).permute(0, 3, 1, 2).float() / 255.0
steering = torch.from_numpy(data["steering"]).float()[:, None]
height, width = images.shape[2:]


class Steering(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        for inside, outside in ((3, 16), (16, 24), (24, 32), (32, 32)):
            layers += [nn.Conv2d(inside, outside, 3, stride=2, padding=1), nn.BatchNorm2d(outside), nn.ReLU()]
        self.see = nn.Sequential(*layers, nn.Flatten())
        count = self.see(torch.zeros(1, 3, height, width)).shape[1]
        self.steer = nn.Sequential(nn.Linear(count, 64), nn.ReLU(), nn.Linear(64, 1), nn.Tanh())

    def forward(self, image: torch.Tensor) -> torch.Tensor:
        return self.steer(self.see(image))


network = Steering()
optimiser = torch.optim.Adam(network.parameters(), 1e-3)
rounds = 25
schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=rounds * -(-len(images) // 64))
for _ in range(rounds):
    order = torch.randperm(len(images))
    for rows in order.split(64):
        gain = 1.0 + 0.1 * torch.randn(len(rows), 1, 1, 1)
        seen = (images[rows] * gain + 0.02 * torch.randn_like(images[rows])).clamp(0.0, 1.0)
        loss = nn.functional.mse_loss(network(seen), steering[rows])
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
network.eval()
print(f"mean squared error {loss.item():.5f} of a spread of {steering.var().item():.5f}")
torch.onnx.export(
    network, (torch.zeros(1, 3, height, width),), sys.argv[2], input_names=["image"], output_names=["steering"],
    dynamic_shapes={"image": {0: "batch"}}, external_data=False,
)  # fmt: skip
