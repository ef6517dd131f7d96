"""The fidelity gate: is a surrogate good enough for attacks found in it to carry over to the deployment?

It asks two questions of pictures alone, before any deployment. Do learned and real pictures of one place look alike (PSNR, SSIM),
and does the policy steer alike on them? And, with an attack: does the object move the steering in the real picture as it does in the
learned one (the *effect*: steering with the attack minus steering without, on the same view)? The second gives a prediction of
transfer, see `advnerf_core/attack/transfer.py`. No deployed drive with the attack is used here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from advnerf_core.scene.gate_limits import GateLimits
from advnerf_core.scene.metrics import psnr, ssim

Floats = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SceneAgreement:
    """Comparison of learned and real pictures of the same places at the policy's size.

    Attributes:
        psnr_db: PSNR of each view [dB].
        real: Steering on each real picture.
        learned: Steering on each learned one.
    """

    psnr_db: Floats
    ssim: Floats
    real: Floats
    learned: Floats

    def __post_init__(self) -> None:
        shapes = {np.shape(values) for values in (self.psnr_db, self.ssim, self.real, self.learned)}
        if len(shapes) != 1 or len(next(iter(shapes))) != 1 or not len(self.real):
            raise ValueError(f"expected one number per view in each, got shapes {sorted(shapes)}")
        if not all(np.isfinite(values).all() for values in (self.ssim, self.real, self.learned)):
            raise ValueError("expected finite similarity and steering; a policy or picture is broken")

    @property
    def difference(self) -> Floats:
        """Steering on the learned picture minus steering on the real one, per view."""
        return self.learned - self.real

    @property
    def correlation(self) -> float:
        """Pearson's correlation of the steering; 1 if both are constant and equal, 0 if one is constant."""
        if np.ptp(self.real) == 0.0 or np.ptp(self.learned) == 0.0:
            return 1.0 if np.array_equal(self.real, self.learned) else 0.0
        return float(np.corrcoef(self.real, self.learned)[0, 1])

    def summary(self) -> dict[str, float | int]:
        """Numbers for a page."""
        return {
            "views": len(self.real),
            "psnr_db": float(self.psnr_db.mean()),
            "ssim": float(self.ssim.mean()),
            "steering": float(np.abs(self.difference).mean()),
            "steering_worst": float(np.abs(self.difference).max()),
            "steering_bias": float(self.difference.mean()),
            "correlation": self.correlation,
        }


def agreement(
    real: Sequence[Any], learned: Sequence[Any], steer_real: ArrayLike, steer_learned: ArrayLike
) -> SceneAgreement:
    """Compare pictures.

    Args:
        real: Real pictures ``[H, W, 3]``, uint8 or 0..1, at the policy's size.
        learned: Learned ones of the same places.
        steer_real: The policy's output ``[N]`` on the real ones.
        steer_learned: The same on the learned ones.
    """
    if len(real) != len(learned) or not len(real):
        raise ValueError(
            f"expected as many learned as real pictures, and some, got {len(learned)} and {len(real)}"
        )
    pairs = list(zip(learned, real, strict=True))
    return SceneAgreement(
        np.array([psnr(a, b) for a, b in pairs]),
        np.array([ssim(a, b) for a, b in pairs]),
        np.asarray(steer_real, np.float64),
        np.asarray(steer_learned, np.float64),
    )


@dataclass(frozen=True)
class Verdict:
    """The gate's decision on one set of pictures.

    Attributes:
        passed: Whether attacks may proceed.
        reasons: Missed limits as text; empty if all are kept.
    """

    passed: bool
    reasons: tuple[str, ...]
    numbers: dict[str, float | int]

    def record(self) -> dict[str, Any]:
        """JSON-ready values."""
        return asdict(self)


def judge(found: SceneAgreement, limits: GateLimits, of: str = "held-out views") -> Verdict:
    """Compare the measured values with the limits.

    Args:
        of: Name of the comparison, for the reasons.
    """
    numbers = found.summary()
    reasons = reasons_against(numbers, limits, of)
    return Verdict(not reasons, reasons, numbers)


def reasons_against(n: Mapping[str, float | int], limits: GateLimits, of: str) -> tuple[str, ...]:
    """Limits that a comparison's numbers, from `SceneAgreement.summary`, miss, as text."""
    checks = (
        (n["views"] >= limits.views, f"{n['views']} pictures, at least {limits.views} needed"),
        (
            n["psnr_db"] >= limits.psnr_db,
            f"PSNR {n['psnr_db']:.2f} dB, at least {limits.psnr_db:g} needed: train the scene longer, or take more pictures",
        ),
        (n["ssim"] >= limits.ssim, f"SSIM {n['ssim']:.3f}, at least {limits.ssim:g} needed"),
        (
            n["steering"] <= limits.steering,
            f"mean steering difference {n['steering']:.4f}, at most {limits.steering:g} allowed: train the policy on learned pictures too",
        ),
        (
            n["correlation"] >= limits.correlation,
            f"correlation of the steering {n['correlation']:.3f}, at least {limits.correlation:g} needed",
        ),
    )
    return tuple(f"{of}: {text}" for good, text in checks if not good)


@dataclass(frozen=True, eq=False)
class Effect:
    """Effect of an attack on the steering on single views, learned and real.

    Attributes:
        learned: Steering with minus without the attack, on the learned picture of each view.
        real: The same on the real picture, into which the object was composed.
    """

    learned: Floats
    real: Floats

    def __post_init__(self) -> None:
        if np.ndim(self.learned) != 1 or np.shape(self.learned) != np.shape(self.real) or not len(self.real):
            raise ValueError(
                f"expected one effect per view, got shapes {np.shape(self.learned)} and {np.shape(self.real)}"
            )
        if not (np.isfinite(self.learned).all() and np.isfinite(self.real).all()):
            raise ValueError("expected finite effects, got some that are not")

    @property
    def retained(self) -> float:
        """Share of the effect that survives in real pictures: the slope of least squares through the origin; 0 without an effect."""
        energy = float(self.learned @ self.learned)
        return float(self.learned @ self.real) / energy if energy > 0.0 else 0.0

    @property
    def residual(self) -> Floats:
        """Part of the effect that the share does not explain, per view."""
        return self.real - self.retained * self.learned


@dataclass(frozen=True, eq=False)
class PicturePairs:
    """Real and learned pictures of the same places at the policy's size, in the order of the path if there is one.

    Attributes:
        of: Title of the pictures.
        real: ``[N, H, W, 3]`` uint8 from the deployment.
        learned: ``[N, H, W, 3]`` uint8 from the surrogate.
    """

    of: str
    real: NDArray[np.uint8]
    learned: NDArray[np.uint8]

    def __post_init__(self) -> None:
        if self.real.ndim != 4 or self.real.shape != self.learned.shape or not len(self.real):
            raise ValueError(
                f"expected real and learned pictures [N, H, W, 3], got {self.real.shape} and {self.learned.shape}"
            )
