"""One training step in plain torch, on any device: for accelerators, and as the second implementation of ``CpuStep``.

Same samples, same loss, same optimiser, differentiated by torch; tests compare the two.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor
from torch.nn.functional import huber_loss

from advnerf_core.render.march import Samples
from advnerf_core.render.volume_kernels import MIN_TRANSMITTANCE
from advnerf_core.scene.exposure import RayGains
from advnerf_core.scene.field import SceneField
from advnerf_core.scene.train_step import Array32, Matte, StepResult, distortion_distances

_MEAN_DECAY, _SQUARE_DECAY, _TINY = 0.9, 0.99, 1e-15


class TorchStep:
    """Gradients and Adam for a scene field on its device; a drop-in for ``CpuStep``.

    Args:
        scene: The field; its parameters are changed in place.
        huber: Error at which the loss changes from square to linear.
        distortion: Weight of the distortion loss, with the distances of ``distortion_distances``.
        opacity: Weight of the mean transmittance of rays in the loss.
    """

    def __init__(
        self, scene: SceneField, huber: float = 0.1, distortion: float = 0.0, opacity: float = 0.0
    ) -> None:
        self.scene, self.huber = scene, huber
        self.distortion, self.opacity = distortion, opacity
        self.values = dict(scene.named_parameters())
        self.means = {name: torch.zeros_like(value) for name, value in self.values.items()}
        self.squares = {name: torch.zeros_like(value) for name, value in self.values.items()}

    @property
    def grads(self) -> dict[str, Tensor]:
        """Gradients accumulated since the last update, by the parameter's name."""
        return {n: torch.zeros_like(v) if v.grad is None else v.grad for n, v in self.values.items()}

    def step(
        self,
        rays: Array32,
        targets: NDArray[np.uint8],
        samples: Samples,
        matte: Matte | None = None,
        exposure: RayGains | None = None,
    ) -> StepResult:
        """Add the gradient of a batch over its visible samples; arguments as in ``gradients``."""
        return self.gradients(rays, targets, self.visible(samples), matte, exposure)

    def visible(self, samples: Samples, least_weight: float = 5e-4) -> Samples:
        """Samples that are visible in the image."""
        with torch.no_grad():
            density = torch.exp(self._log_density(self._tensor(samples.points)))
            weights, _, through = _weights(density * self._tensor(samples.widths), samples)
            keep = ((weights >= least_weight) & (through >= MIN_TRANSMITTANCE)).cpu().numpy()
        kept, before = np.flatnonzero(keep), np.concatenate([[0], np.cumsum(keep)])
        return Samples(
            samples.points[kept], samples.t_mid_m[kept], samples.widths[kept], before[samples.begins]
        )

    def gradients(
        self,
        rays: Array32,
        targets: NDArray[np.uint8],
        samples: Samples,
        matte: Matte | None = None,
        exposure: RayGains | None = None,
    ) -> StepResult:
        """Add the gradient of the mean Huber loss of a batch to the parameters' ``grad``.

        Args:
            rays: ``[R, 6]`` in box coordinates.
            targets: Pixels ``[R, 3]``.
            matte: Opacities of the pixels and the colours behind them; for a field without a learned background.
            exposure: Gains on the field's colours, whose gradient is written.
        """
        with torch.enable_grad():
            colours, weights, alpha = render_rays(self.scene, self._tensor(rays), samples)
            logs = None if exposure is None else self._tensor(exposure.gains).log().requires_grad_()
            if logs is not None:
                colours = exposed(colours, logs, self._tensor(targets))
            real = self._tensor(targets) / 255.0
            if matte is not None:
                behind, opacity = self._tensor(matte.behind), self._tensor(matte.opacities)[:, None] / 255.0
                colours = alpha[:, None] * colours + (1.0 - alpha[:, None]) * behind
                real = opacity * real + (1.0 - opacity) * behind
            loss = huber_loss(colours, real, delta=float(self.huber))
            total = loss + self.opacity * (1.0 - alpha).mean()
            if self.distortion > 0.0:
                middles, lengths = distortion_distances(samples, self.scene.config)
                spread = distortion_loss(weights, self._tensor(middles), self._tensor(lengths), samples)
                total = total + self.distortion * spread / max(len(rays), 1)
            total.backward()
        if exposure is not None and logs is not None and logs.grad is not None:
            exposure.grad_log[...] = logs.grad.float().cpu().numpy()
        mse = torch.mean((colours.detach() - real) ** 2)
        return StepResult(loss.item(), mse.item(), len(rays), len(samples.points))

    @torch.no_grad()
    def update(self, step: int, rate: float) -> None:
        """Adam with the gradients accumulated since the last update; ``step`` counts from 0.

        As in the kernel, table entries without samples are unchanged, including moments.
        """
        mean_scale = 1.0 / (1.0 - _MEAN_DECAY ** (step + 1))
        square_scale = 1.0 / (1.0 - _SQUARE_DECAY ** (step + 1))
        for name, value in self.values.items():
            if value.grad is None:
                continue
            g, mean, square = value.grad, self.means[name], self.squares[name]
            # Entries without samples interpolate with weight zero: branches cost more than arithmetic on a GPU.
            measured = (g != 0.0).to(g.dtype) if name == "grid.table" else torch.ones((), device=g.device)
            mean.lerp_(g, (1.0 - _MEAN_DECAY) * measured.expand_as(g))
            square.lerp_(g * g, (1.0 - _SQUARE_DECAY) * measured.expand_as(g))
            value.sub_(measured * rate * (mean * mean_scale) / ((square * square_scale).sqrt() + _TINY))
            value.grad = None

    def state(self) -> dict[str, Array32]:
        """Parameters and moments by kind and name, as in ``CpuStep``: a checkpoint of one resumes in the other."""
        return {name: tensor.detach().cpu().numpy() for name, tensor in self._state().items()}

    @torch.no_grad()
    def load_state(self, state: dict[str, Array32]) -> None:
        """Restore a ``state``."""
        for name, tensor in self._state().items():
            tensor.copy_(torch.from_numpy(np.ascontiguousarray(state[name])))

    def _state(self) -> dict[str, Tensor]:
        kinds: dict[str, dict[str, Tensor]] = {
            "value": {**self.values},
            "mean": self.means,
            "square": self.squares,
        }
        return {
            f"{kind}.{name}": tensor for kind, tensors in kinds.items() for name, tensor in tensors.items()
        }

    def log_density(self, points: Array32) -> Array32:
        """Logarithm of density per box side ``[N]`` at points ``[N, 3]`` in box coordinates."""
        with torch.no_grad():
            return np.asarray(self._log_density(self._tensor(points)).float().cpu().numpy())

    def _log_density(self, points: Tensor) -> Tensor:
        s = self.scene
        out: Tensor = s.density_2(torch.relu(s.density_1(s.grid(points))))
        return out[:, 0]

    def _tensor(self, array: NDArray[np.float32] | NDArray[np.uint8]) -> Tensor:
        background = self.scene.background
        return torch.from_numpy(np.ascontiguousarray(array)).to(background.device, background.dtype)


def render_rays(scene: SceneField, rays: Tensor, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Volume rendering in plain torch, differentiable to the scene's parameters.

    Args:
        scene: The field, on any device.
        rays: ``[R, 6]`` in box coordinates.

    Returns:
        Colours ``[R, 3]``, weights of the samples ``[N]`` and opacity of the rays ``[R]``.
    """
    device, dtype = scene.background.device, scene.background.dtype
    density, features = scene.density_and_features(torch.from_numpy(samples.points).to(device, dtype))
    weights, ray_of, _ = _weights(density * torch.from_numpy(samples.widths).to(device, dtype), samples)
    total = torch.zeros(samples.rays, features.shape[1], device=device, dtype=dtype)
    total = total.index_add(0, ray_of, weights[:, None] * features)
    alpha = torch.zeros(samples.rays, device=device, dtype=dtype).index_add(0, ray_of, weights)
    directions = torch.nn.functional.normalize(rays[:, 3:].to(device, dtype), dim=-1)
    return scene.decode(total + (1.0 - alpha)[:, None] * scene.background, directions), weights, alpha


def exposed(colours: Tensor, log_gains: Tensor, targets: Tensor) -> Tensor:
    """Colours ``[R, 3]`` times gains; at most 1 where the pixel ``[R, 3]`` is 255, which is only a lower bound."""
    shown = colours * torch.exp(log_gains)
    return torch.where(targets == 255.0, shown.clamp(max=1.0), shown)


def distortion_loss(weights: Tensor, middles: Tensor, widths: Tensor, samples: Samples) -> Tensor:
    """``sum_ij w_i w_j |m_i - m_j| + 1/3 sum_i w_i^2 d_i``, summed over rays (Barron et al. 2022, equation 15).

    Linear in the number of samples: a ray's samples are sorted, so ``sum_ij`` is twice a sum of prefix sums.
    """
    ray_of, first = _ray_of(samples, weights.device)
    # Whole-batch prefix sums in double precision: their differences must stay exact to single.
    w, m = weights.double(), middles.double()
    before = _since(torch.cumsum(w, 0) - w, first, ray_of)
    moment = _since(torch.cumsum(w * m, 0) - w * m, first, ray_of)
    apart = 2.0 * (w * (m * before - moment)).sum()
    return (apart + (w * w * widths.double()).sum() / 3.0).to(weights.dtype)


def _weights(depth: Tensor, samples: Samples) -> tuple[Tensor, Tensor, Tensor]:
    """Rendering weights ``[N]`` of optical depths, the ray of each sample ``[N]``, and the light that reaches it ``[N]``."""
    ray_of, first = _ray_of(samples, depth.device)
    # One running sum over the whole batch grows large where rays are opaque: in single precision it would lose thin air.
    running = torch.cumsum(depth.double(), 0) - depth.double()
    through = torch.exp(-_since(running, first, ray_of)).to(depth.dtype)
    through = torch.where(through < MIN_TRANSMITTANCE, torch.zeros_like(through), through)
    return through * (1.0 - torch.exp(-depth)), ray_of, through


def _ray_of(samples: Samples, device: torch.device) -> tuple[Tensor, Tensor]:
    begins = torch.from_numpy(samples.begins).to(device)
    ray_of = torch.repeat_interleave(torch.arange(samples.rays, device=device), begins.diff())
    return ray_of, begins[:-1].clamp(max=max(len(ray_of) - 1, 0))


def _since(running: Tensor, first: Tensor, ray_of: Tensor) -> Tensor:
    """A running sum over the batch, counted from the first sample of each ray."""
    return running - running[first][ray_of] if len(running) else running
