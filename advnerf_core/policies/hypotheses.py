"""Searches the wrong declaration that would explain a policy's outputs on images with known steering.

Every hypothesis is a declaration other than the given one: swapped colours, another range, another unit, the other
sign. The network is run under each, and the hypothesis whose steering lies nearest to the expert's is believed if it
explains much more than the declaration does. One error of input and one of output may be combined.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from advnerf_core.policies.adapter import AdaptedPolicy
from advnerf_core.policies.colours import ColourSpace
from advnerf_core.policies.contract import PolicyContract
from advnerf_core.policies.network import images_to_tensor

Array = NDArray[np.float64]

# A hypothesis is believed if it leaves less than this share of the declaration's error, and explains something by itself ...
BELIEVED_SHARE = 0.9
USEFUL_ERROR = 0.8
# ... and if that is no accident of the frames: the mean of the paired differences, in its standard errors.
BELIEVED_DEVIATIONS = 3.0
_BATCH = 32
_UNIT_WORDS = {"deg": "degrees", "rad": "radians", "normalised": "normalised angles", "1/m": "inverse radii"}
_IMAGENET = ((0.485, 0.456, 0.406), (0.229, 0.224, 0.225))


@dataclass(frozen=True)
class Hypothesis:
    """An alternative declaration with its explanation.

    Attributes:
        found: The error that it assumes; empty for the declaration itself.
        advice: Change to make; empty for the declaration itself.
        contract: The declaration that it proposes.
    """

    found: tuple[str, ...]
    advice: tuple[str, ...]
    contract: PolicyContract


@dataclass(frozen=True)
class Judgement:
    """Comparison of the declaration and the best alternative with the expert.

    Attributes:
        declared_error: Mean error relative to always steering the expert's median; below 1 is better than no policy.
        deviations: Mean of the frames' differences in error between the two, over its standard error.
    """

    declared_error: float
    best: Hypothesis
    best_error: float
    deviations: float

    @property
    def believed(self) -> bool:
        """Whether the declaration is believed to be wrong in the way of the hypothesis."""
        better = (
            self.best_error < BELIEVED_SHARE * self.declared_error and self.deviations > BELIEVED_DEVIATIONS
        )
        return bool(self.best.found) and better and self.best_error < USEFUL_ERROR


def judge(
    policy: AdaptedPolicy, images: NDArray[np.uint8], steering_rad: Array, goal: Array | None = None
) -> Judgement:
    """Try every hypothesis.

    Args:
        policy: A policy of stateless steering.
        images: Policy images ``[N, H, W, 3]`` uint8 RGB.
        steering_rad: The expert's steering ``[N]`` [rad], left positive; it must vary.
        goal: Goal vector, for a policy that has goals.
    """
    wanted = np.asarray(steering_rad, dtype=np.float64)
    scale = float(np.abs(wanted - np.median(wanted)).mean())
    if not scale > 0.0:
        raise ValueError("expected reference frames whose steering varies, got one angle for all")
    declared = np.abs(steering_of(policy, policy.contract, images, goal) - wanted)
    best, best_errors = Hypothesis((), (), policy.contract), declared
    for hypothesis in _hypotheses(policy.contract):
        errors = np.abs(steering_of(policy, hypothesis.contract, images, goal) - wanted)
        # A second change must earn its place: of nearly equal hypotheses, the one with fewer changes wins.
        penalty = 1.1 ** (len(hypothesis.found) - len(best.found))
        if np.isfinite(errors).all() and errors.mean() * max(penalty, 1.0) < best_errors.mean():
            best, best_errors = hypothesis, errors
    gains = declared - best_errors
    spread = float(gains.std()) / np.sqrt(len(gains))
    deviations = float(gains.mean()) / spread if spread > 0.0 else 0.0
    return Judgement(float(declared.mean()) / scale, best, float(best_errors.mean()) / scale, deviations)


@torch.no_grad()
def steering_of(
    policy: AdaptedPolicy, contract: PolicyContract, images: NDArray[np.uint8], goal: Array | None = None
) -> Array:
    """Steering ``[N]`` [rad] of a policy's network under a given declaration of the same view."""
    assumed = AdaptedPolicy(policy.network, contract)
    steering: list[Any] = []
    for first in range(0, len(images), _BATCH):
        batch = images_to_tensor(images[first : first + _BATCH])
        goals = None if goal is None else torch.tensor(goal, dtype=torch.float32).expand(len(batch), -1)
        if assumed.stateless:
            steering.append(assumed(batch, goals))
        else:
            steering.append(assumed(batch, goals, assumed.initial_memory(len(batch)))[0])
    return np.asarray(torch.cat(steering).double().numpy())


def _hypotheses(contract: PolicyContract) -> Iterator[Hypothesis]:
    inputs = [Hypothesis((), (), contract), *_input_changes(contract)]
    for first in inputs:
        for second in [Hypothesis((), (), first.contract), *_output_changes(first.contract)]:
            if first.found or second.found:
                yield Hypothesis(first.found + second.found, first.advice + second.advice, second.contract)


def _input_changes(contract: PolicyContract) -> Iterator[Hypothesis]:
    ranges = list(_range_changes(contract))
    yield from ranges
    for base in [Hypothesis((), (), contract), *ranges]:
        # A network of one channel supports no other space, nor the reverse.
        spaces: tuple[ColourSpace, ...] = () if contract.channels == 1 else ("RGB", "BGR", "YUV")
        for other in spaces:
            if other != contract.colour_space:
                yield Hypothesis(
                    (*base.found, f"takes {other} for {contract.colour_space}"),
                    (*base.advice, f"set colour_space = {other!r}"),
                    replace(base.contract, colour_space=other),
                )


def _range_changes(contract: PolicyContract) -> Iterator[Hypothesis]:
    plain = not any(contract.mean) and all(value == 1.0 for value in contract.std)
    other = 255.0 if contract.value_max == 1.0 else 1.0
    if plain:
        yield Hypothesis(
            (f"expects values of 0..{other:g}, but is given 0..{contract.value_max:g}",),
            (f"set value_max = {other:g}",),
            replace(contract, value_max=other),
        )
        if contract.channels == 3:
            yield Hypothesis(
                ("expects ImageNet's normalisation, but is given plain values",),
                (f"set value_max = 1, mean = {_IMAGENET[0]} and std = {_IMAGENET[1]}",),
                replace(contract, value_max=1.0, mean=_IMAGENET[0], std=_IMAGENET[1]),
            )
        yield Hypothesis(
            ("expects values of -1..1, but is given others",),
            ("set value_max = 1, mean = (0.5,) and std = (0.5,)",),
            replace(contract, value_max=1.0, mean=(0.5,), std=(0.5,)),
        )
        return
    for value_max in (1.0, 255.0):
        yield Hypothesis(
            (f"expects plain values of 0..{value_max:g}, but is given normalised ones",),
            (f"leave mean and std out and set value_max = {value_max:g}",),
            replace(contract, value_max=value_max, mean=(0.0,), std=(1.0,)),
        )


def _output_changes(contract: PolicyContract) -> Iterator[Hypothesis]:
    side = "right" if contract.positive == "left" else "left"
    of_side = (f"steers positive to the {side}, not to the {contract.positive}", f"set positive = {side!r}")
    # Waypoints are in metres.
    units = [unit for unit in ("deg", "rad") if unit != contract.output_unit and contract.trajectory is None]
    bases: list[tuple[tuple[tuple[str, str], ...], PolicyContract]] = [((), contract)]
    for unit in units:
        words = f"steers in {_UNIT_WORDS[unit]} for {_UNIT_WORDS[contract.output_unit]}"
        # Without keys that belong to the declared unit only.
        other = replace(contract, output_unit=unit, full_steering_rad=None, wheelbase_m=None)  # type: ignore[arg-type]
        bases.append((((words, f"set output_unit = {unit!r}"),), other))
    for found, base in bases:
        if found:
            yield Hypothesis((found[0][0],), (found[0][1],), base)
        both = (*found, of_side)
        turned = replace(base, positive=side)  # type: ignore[arg-type]
        yield Hypothesis(tuple(each[0] for each in both), tuple(each[1] for each in both), turned)
