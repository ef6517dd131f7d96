"""Checks a policy's adapter; each finding is a sentence that says what to change."""

from __future__ import annotations

import random
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Final, Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from advnerf_core.plugins import FAILURES, in_one_line
from advnerf_core.policies.adapter import AdaptedPolicy
from advnerf_core.policies.answer import answer
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.hypotheses import USEFUL_ERROR, Array, judge, steering_of
from advnerf_core.policies.network import images_to_tensor

Verdict = Literal["ok", "warning", "failure"]
OK: Final = "ok"
WARNING: Final = "warning"
FAILURE: Final = "failure"

# Larger than any car's wheel angle [rad].
LARGEST_STEERING_RAD = 1.2
# Outputs that should be equal may differ by this share of their spread: batched kernels round differently.
_EQUAL_SHARE = 1e-3
_CONSTANT_RAD = 1e-6
_SIZE_ADVICE = (
    "set the view's width and height to the size it was trained with, and the output to [B] or [B, 1]"
)
_PROBES = 4
# Pictures of patches of one colour, rows by columns: a policy that looks for something finds it there rather than in noise.
_PATCHES = (6, 8)
_MODES = (nn.modules.dropout._DropoutNd, nn.modules.batchnorm._BatchNorm)


@dataclass(frozen=True)
class Finding:
    """One line of the report.

    Attributes:
        verdict: ``ok``, ``warning`` or ``failure``.
        text: The finding, and what to change.
    """

    name: str
    verdict: Verdict
    text: str


def check_policy(
    policy: AdaptedPolicy,
    images: NDArray[np.uint8],
    steering_rad: Array | None = None,
    goal: tuple[float, ...] | None = None,
    methods: Sequence[str] = (),
) -> list[Finding]:
    """All checks of a policy from the outside; checks that an earlier failure makes meaningless are left out.

    Args:
        policy: The policy in its author's mode.
        images: Policy images ``[N, H, W, 3]`` uint8 RGB of the policy's own view, at least 4 and not all alike.
        steering_rad: The expert's steering on them ``[N]`` [rad], left positive; None skips the comparison.
        goal: Goal vector for a policy that has goals; zeros if not given.
        methods: Methods of attack that need no gradient; named if the policy declares that it has none.
    """
    if len(images) < _PROBES:
        raise ValueError(f"expected at least {_PROBES} images, got {len(images)}")
    examined = _Examined(policy, goal, methods)
    findings = [_mode(policy)]
    runs = _runs(examined, images)
    findings.append(runs)
    if runs.verdict == FAILURE:
        return findings
    for name, look in _LOOKS:
        try:
            finding = look(examined, images)
        except Exception as error:  # such as a forward that leaves torch
            finding = Finding(name, FAILURE, f"the network fails: {in_one_line(error):.160}")
        findings.append(finding)
        if finding.verdict == FAILURE and look in (_finite, _repeatable):
            return findings
    findings.append(_range(examined, images))
    if findings[-1].verdict != FAILURE and steering_rad is not None:
        findings.append(_expert(examined, images, steering_rad))
    elif steering_rad is not None and np.ptp(examined.steering(images)) > _CONSTANT_RAD:
        findings[-1] = _expert(examined, images, steering_rad)
    return findings


def require_steady(policy: AdaptedPolicy, name: str) -> None:
    """Refuse a policy whose answer to a picture is random, or depends on earlier pictures or on the rest of a batch.

    It takes five batches and four single pictures, or three pictures of a policy that queries another program. Global random numbers go on as
    if nothing had been asked. A policy that fails at these pictures passes: its drive tells why.

    Raises:
        PolicyContractError: It answers the same picture in different ways.
    """
    examined = _Examined(policy, None)
    images = _patches(2, policy.contract.size)
    looks = (_asked_again,) if policy.identity else (_repeatable, _independent)
    for look in looks:
        try:
            with _seeded(0):
                finding = look(examined, images)
        except FAILURES:
            return
        if finding.verdict == FAILURE:
            raise PolicyContractError(
                f"{name}: expected a policy that answers a picture always the same: {finding.text}"
            )


def _patches(count: int, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Pictures ``[count, H, W, 3]`` of random patches."""
    rows, columns = (
        np.arange(pixels) * patches // pixels for pixels, patches in zip(size, _PATCHES, strict=True)
    )
    patches = np.random.default_rng(0).integers(0, 256, (count, *_PATCHES, 3), np.uint8)
    return patches[:, rows][:, :, columns]


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Global random numbers of torch, NumPy and Python from a seed; afterwards they go on as before."""
    devices = list(range(torch.cuda.device_count())) if torch.cuda.is_initialized() else []
    of_numpy, of_python = np.random.get_state(), random.getstate()  # noqa: NPY002 (the global one is what code of others uses)
    with torch.random.fork_rng(devices=devices):
        # Not torch.manual_seed: it would also seed a GPU that is used later, for the rest of the process.
        torch.default_generator.manual_seed(seed)
        if devices:
            torch.cuda.manual_seed_all(seed)
        np.random.seed(seed)  # noqa: NPY002
        random.seed(seed)
        try:
            yield
        finally:
            np.random.set_state(of_numpy)  # noqa: NPY002
            random.setstate(of_python)


class _Examined:
    """A policy and its goal, called on plain images."""

    def __init__(
        self, policy: AdaptedPolicy, goal: tuple[float, ...] | None, methods: Sequence[str] = ()
    ) -> None:
        self.policy, self.methods = policy, methods
        size = policy.contract.goal_size
        self.goal = None if size == 0 else np.array(goal if goal is not None else (0.0,) * size)

    def steering(self, images: NDArray[np.uint8]) -> Array:
        return steering_of(self.policy, self.policy.contract, images, self.goal)

    def goals(self, images: Tensor) -> Tensor | None:
        return (
            None if self.goal is None else torch.tensor(self.goal, dtype=images.dtype).expand(len(images), -1)
        )

    def __call__(self, images: Tensor) -> Tensor:
        goals = self.goals(images)
        if self.policy.stateless:
            steering: Tensor = self.policy(images, goals)
        else:
            steering, _ = self.policy(images, goals, self.policy.initial_memory(len(images)))
        return steering


def _mode(policy: AdaptedPolicy) -> Finding:
    network = policy.network
    if not isinstance(network, nn.Module):
        return Finding("mode", OK, "no torch module, so no training mode")
    left_on = [name or "the network" for name, part in network.named_modules() if part.training]
    if not left_on:
        return Finding("mode", OK, "eval mode")
    acting = [type(part).__name__ for part in network.modules() if part.training and isinstance(part, _MODES)]
    what = f", with {', '.join(sorted(set(acting)))} at work" if acting else ""
    return Finding("mode", FAILURE, f"{left_on[0]} is in training mode{what}; call .eval() before adapt()")


def _runs(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    height, width = examined.policy.contract.size
    batch = images_to_tensor(images[:2])
    try:
        with torch.no_grad():
            examined(batch)
    except PolicyContractError as error:
        return Finding("input", FAILURE, str(error))
    except Exception as error:  # a user's network may raise anything
        reason = " ".join(traceback.format_exception_only(error)[-1].split())
        return Finding(
            "input",
            FAILURE,
            f"fails on images [B, 3, {height}, {width}]: {reason:.160}; {_remedy(examined, batch)}",
        )
    return Finding("input", OK, f"takes images [B, 3, {height}, {width}], returns steering [B]")


def _remedy(examined: _Examined, batch: Tensor) -> str:
    """The other shape that the network would accept."""
    contract = examined.policy.contract
    given = contract.first_input(batch)
    if given.ndim != len(batch.shape):
        return _SIZE_ADVICE
    # As NCHW it would get the other layout's axes; then height and width swapped; then other common sizes.
    other = given.permute(0, 2, 3, 1) if contract.layout == "NCHW" else given.permute(0, 3, 1, 2)
    attempts: list[tuple[str, Tensor]] = [
        (f"set layout = {'NHWC' if contract.layout == 'NCHW' else 'NCHW'!r}", other),
        ("exchange width and height of the view", given.transpose(-1, -2)),
    ]
    if contract.colour_space != "GRAY" and contract.layout == "NCHW":
        attempts.append(("set colour_space = 'GRAY'", given[:, :1]))
    for height, width in ((66, 200), (160, 320), (120, 160), (224, 224), (128, 128), (64, 64), (480, 640)):
        if contract.layout == "NCHW" and (height, width) != contract.size:
            attempts.append(
                (f"set width = {width} and height = {height} in the view", _resized(given, height, width))
            )
    for advice, images in attempts:
        if _accepts(examined, images):
            return advice
    return _SIZE_ADVICE


def _resized(images: Tensor, height: int, width: int) -> Tensor:
    return nn.functional.interpolate(images, (height, width), mode="area")


def _accepts(examined: _Examined, given: Tensor) -> bool:
    policy = examined.policy
    extra: list[Any] = [] if examined.goal is None else [examined.goals(given)]
    try:
        with torch.no_grad():
            raw = policy.network(given.contiguous(), *extra)
            policy.contract.to_steering_rad(raw, len(given))
    except Exception:  # it does not accept this shape either
        return False
    return True


def _finite(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    extremes = np.stack([np.zeros_like(images[0]), np.full_like(images[0], 255)])
    for name, batch in (("the reference frames", images), ("a black and a white image", extremes)):
        if not np.isfinite(examined.steering(batch)).all():
            advice = "look for a division by a spread or a logarithm of zero, and for damaged weights"
            return Finding("finite", FAILURE, f"the output on {name} is NaN or infinite; {advice}")
    return Finding("finite", OK, "finite on every image, also on black and white")


def _answer(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    """Its answer to the first image, in the declaration's terms."""
    policy, contract, batch = examined.policy, examined.policy.contract, images_to_tensor(images[:1])
    memory = None if policy.stateless else policy.initial_memory(1)
    with torch.no_grad():
        raw, _ = answer(contract, policy.network, batch, examined.goals(batch), memory)
        steering_rad = float(contract.to_steering_rad(raw, 1)[0])
    side = "left" if steering_rad > 0.0 else "right"
    text = f"to the first image {steering_rad:+.3f} rad, {abs(np.rad2deg(steering_rad)):.1f} degrees to the {side}"
    if contract.trajectory is not None:
        waypoints = contract.waypoints_m(raw, 1)
        x, y = waypoints[0, -1].tolist()
        speed_mps = float(contract.trajectory.speed_mps(waypoints)[0])
        text += (
            f", for waypoints up to {x:.2f} m ahead and {y:+.2f} m to the left; their speed, {speed_mps:.2f} m/s, is not used by searches "
            "and experiments, whose cars have a constant one"
        )
    return Finding("answer", OK, text)


def _repeatable(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    """Distinguishes randomness from memory: with the same seed, only memory makes a difference."""
    first, other = images[:_PROBES], images[-_PROBES:][::-1]

    def seeded(batch: NDArray[np.uint8], seed: int) -> Array:
        with _seeded(seed):
            return examined.steering(batch)

    before = seeded(first, 0)
    seeded(255 - other, 0)
    after, reseeded = seeded(first, 0), seeded(first, 1)
    seed_again = seeded(first, 1)
    tolerance = _tolerance(before)
    if np.abs(after - before).max() > tolerance or np.abs(seed_again - reseeded).max() > tolerance:
        text = (
            "declared stateless, but the output depends on the images before, or on a random generator of its own; declare stateless = False and hand the memory "
            "through forward(images, goals, memory), or clear it on every call"
        )
        if not examined.policy.stateless:
            text = "keeps a memory or a random generator of its own besides the memory it is handed; put everything into the memory that forward returns"
        return Finding("repeatable", FAILURE, text)
    if np.abs(reseeded - before).max() > tolerance:
        text = "the output is random: dropout or noise is left on; call .eval(), and give functional dropout training=self.training"
        return Finding("repeatable", FAILURE, text)
    return Finding("repeatable", OK, "the same image gives the same steering")


def _asked_again(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    """The same of another program, which no seed of ours reaches, with few questions."""
    before = examined.steering(images[:1])
    examined.steering(255 - images[:1])
    if np.abs(examined.steering(images[:1]) - before).max() > _tolerance(before):
        text = (
            f"{examined.policy.identity} answers a picture otherwise when it is asked again: it draws lots, or remembers an earlier drive; "
            "seed it, and clear its memory at the start of a drive"
        )
        return Finding("repeatable", FAILURE, text)
    return Finding("repeatable", OK, "the same image gives the same steering")


def _independent(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    batch = np.concatenate([images[:_PROBES], 255 - images[:_PROBES]])
    together = examined.steering(batch)
    alone = np.concatenate([examined.steering(image[None]) for image in batch])
    worst = float(np.abs(together - alone).max())
    if worst > _tolerance(together):
        text = (
            f"an image steers differently in a batch than alone (by up to {worst:.3g} rad); put batch normalisation into eval mode "
            "and take no mean or maximum over the batch"
        )
        return Finding("batch", FAILURE, text)
    return Finding("batch", OK, "an image steers the same alone and in a batch")


def _gradient(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    declared = examined.policy.differentiable
    if not declared:
        how = f" ({', '.join(examined.methods)})" if examined.methods else ""
        return Finding("gradient", OK, f"declared a black box: attacked without a gradient{how}")
    batch = images_to_tensor(images[:_PROBES]).contiguous().requires_grad_()
    with torch.enable_grad():
        steering = examined(batch)
    if not steering.requires_grad:
        text = (
            "no gradient reaches the image: look for .detach(), .data, .item(), numpy, torch.no_grad() or argmax in forward; or "
            "declare differentiable = False"
        )
        return Finding("gradient", FAILURE, text)
    (slopes,) = torch.autograd.grad(steering.sum(), batch, allow_unused=True)
    if slopes is not None and not bool(torch.isfinite(slopes).all()):
        return Finding(
            "gradient", FAILURE, "the gradient is NaN or infinite; look for sqrt, norm or division at zero"
        )
    if slopes is None or not bool(slopes.abs().sum() > 0.0):
        text = (
            "the gradient is zero everywhere: look for argmax, rounding, clamping or a saturated output, and check the range of "
            "values; or declare differentiable = False"
        )
        return Finding("gradient", FAILURE, text)
    return _slope(examined, batch.detach(), slopes)


def _slope(examined: _Examined, batch: Tensor, slopes: Tensor, step: float = 2e-3) -> Finding:
    """Compare the gradient with the difference of two evaluations along it."""
    direction = slopes.sign()
    with torch.no_grad():
        difference = (examined(batch + step * direction) - examined(batch - step * direction)).double() / (
            2 * step
        )
    expected = (slopes * direction).double().sum(dim=(1, 2, 3))
    error = float((difference - expected).abs().sum() / expected.abs().sum())
    if error > 0.3:
        text = (
            f"the gradient differs from finite differences by {100 * error:.0f} %: look for a detached branch, rounding, or a "
            "straight-through estimator; an attack would follow a wrong direction"
        )
        return Finding("gradient", WARNING, text)
    return Finding("gradient", OK, f"reaches the image, within {100 * error:.1f} % of finite differences")


_LOOKS = (
    ("finite", _finite), ("answer", _answer), ("repeatable", _repeatable), ("batch", _independent), ("gradient", _gradient),
)  # fmt: skip


def _range(examined: _Examined, images: NDArray[np.uint8]) -> Finding:
    steering = examined.steering(images)
    largest = float(np.abs(steering).max())
    if float(np.ptp(steering)) < _CONSTANT_RAD:
        text = f"steers {steering[0]:.4f} rad whatever it sees; check the range of values (value_max) and that the weights are loaded"
        return Finding("range", FAILURE, text)
    if largest > LARGEST_STEERING_RAD:
        advice = "set output_unit = 'deg' if the network was trained on degrees"
        if examined.policy.contract.trajectory is not None:
            advice = "check that the waypoints are in metres in the car's frame, x forward first, and wheelbase_m and lookahead_m"
        text = f"steers up to {largest:.3g} rad, more than any car can; {advice}"
        return Finding("range", FAILURE, text)
    return Finding("range", OK, f"steers {steering.min():+.3f} to {steering.max():+.3f} rad, left positive")


def _expert(examined: _Examined, images: NDArray[np.uint8], steering_rad: Array) -> Finding:
    judgement = judge(examined.policy, images, steering_rad, examined.goal)
    share = f"error {judgement.declared_error:.2f} of that of steering straight through"
    if judgement.believed:
        text = (
            f"{' and '.join(judgement.best.found)}: {' and '.join(judgement.best.advice)} ({share} as declared, "
            f"{judgement.best_error:.2f} so)"
        )
        return Finding("expert", FAILURE, text)
    if judgement.declared_error > USEFUL_ERROR:
        text = (
            f"does not steer as the expert does ({share}), and no other declaration explains why; check the crop of the view and "
            "that the policy was trained for this place"
        )
        return Finding("expert", WARNING, text)
    return Finding("expert", OK, f"steers as the expert does ({share})")


def _tolerance(steering: Array) -> float:
    return _EQUAL_SHARE * max(float(np.abs(steering).max()), 1e-4)
