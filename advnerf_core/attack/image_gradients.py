"""Gradients of a policy's control with respect to its images, in bfloat16 where the processor multiplies it and the direction stays."""

from __future__ import annotations

from typing import Any
from weakref import WeakKeyDictionary

import torch
from torch import Tensor
from torch.nn import functional

from advnerf_core.errors import AdvnerfError, NotFiniteError
from advnerf_core.geometry import Pinhole
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.number_type import layer_type

LEAST_COSINE = 0.9999
"""Least cosine of a gradient in bfloat16 with the one in float32."""

_PROBES = 4  # images on which both are compared
_decided: WeakKeyDictionary[Any, dict[Pinhole, bool]] = WeakKeyDictionary()


def image_gradients(
    policy: Any, images: Tensor, goals: Tensor | None, slopes: Tensor, reduced: bool = False
) -> Tensor:
    """Gradient of ``sum(slopes * policy(images))`` with respect to the images.

    Args:
        policy: A stateless policy.
        images: ``[N, 3, H, W]``, without history.
        goals: ``[N, G]`` or None.
        slopes: ``[N]``.
        reduced: Compute layers in bfloat16; see `agrees_in_bfloat16`.

    Returns:
        ``[N, 3, H, W]``, in the type of the images.

    Raises:
        NotFiniteError: The gradient is not finite.
    """
    if reduced:
        # The layout that convolutions in bfloat16 take without a copy for each layer.
        images = images.contiguous(memory_format=torch.channels_last)
    images = images.detach().requires_grad_()
    with torch.enable_grad(), torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        controls = with_history(policy(images, goals))
    (gradient,) = torch.autograd.grad(controls, images, slopes.to(controls.dtype))
    require_finite_gradient(gradient)
    return gradient


def require_finite_gradient(gradient: Tensor) -> None:
    """Refuse a policy whose steering has a gradient ``[N, 3, H, W]`` with respect to its images that is NaN or infinite.

    Raises:
        NotFiniteError: It is.
    """
    wrong = int((~torch.isfinite(gradient)).flatten(1).any(1).sum())
    if wrong:
        raise NotFiniteError(
            f"expected a finite gradient of the policy's steering with respect to its pictures, got NaN or infinity for {wrong} of {len(gradient)} "
            "pictures; look in the policy for sqrt, norm or division at zero, or search with a method that needs no gradient"
        )


def with_history(steering: Tensor) -> Tensor:
    """The steering that a policy has computed from images, which must have a gradient.

    Raises:
        PolicyContractError: It has none.
    """
    if not steering.requires_grad:
        raise PolicyContractError(
            "expected a policy that is differentiable in its images, got steering without a gradient; compute it with torch, without detach() and "
            "no_grad, or declare differentiable = False and search with a method that needs no gradient"
        )
    return steering


def agrees_in_bfloat16(policy: Any, camera: Pinhole, goal_size: int = 0) -> bool:
    """Whether gradients of this policy may be computed in bfloat16 on this machine.

    They may for a differentiable stateless network in float32 whose gradients in both types have a cosine of at least `LEAST_COSINE`
    on smooth random images. The images depend on nothing else, so that a resumed search decides as it did before.

    Args:
        camera: Size of its images.
        goal_size: Length of its goals; 0 for none.
    """
    network = isinstance(policy, torch.nn.Module) and {each.dtype for each in policy.parameters()} == {
        torch.float32
    }
    if not (network and policy.stateless and layer_type() == torch.bfloat16):
        return False
    decided = _decided.setdefault(policy, {})
    if camera not in decided:
        decided[camera] = _least_cosine(policy, camera, goal_size) >= LEAST_COSINE
    return decided[camera]


def _least_cosine(policy: Any, camera: Pinhole, goal_size: int) -> float:
    generator = torch.Generator().manual_seed(0)
    coarse = torch.rand(_PROBES, 3, camera.height // 8 + 2, camera.width // 8 + 2, generator=generator)
    images = functional.interpolate(coarse, (camera.height, camera.width), mode="bilinear")
    goals = torch.rand(_PROBES, goal_size, generator=generator) if goal_size else None
    slopes = torch.ones(_PROBES)
    try:
        exact, rounded = (
            image_gradients(policy, images, goals, slopes, kind).double().flatten(1) for kind in (False, True)
        )
    except (RuntimeError, AdvnerfError):  # no gradient, or an operation that bfloat16 lacks
        return -1.0
    return float(functional.cosine_similarity(exact, rounded).min())
