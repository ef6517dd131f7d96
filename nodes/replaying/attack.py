"""Retro-attack: applies an attack to a recorded clean drive and computes how the policy would have steered.

Compositor and policy run over the recorded images twice in lockstep, without and with the attack. This is an open loop: the recorded
trajectory does not change. So the result is the effect of the attack on the steering at each image, not on the trajectory.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import write_json
from nodes.bags.decoded import read_decoded
from nodes.bags.reader import read_info
from nodes.control.attack_receiver import ATTACK_FILE
from nodes.control.interlock import ATTACK_SWITCH
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError
from nodes.runtime.messages import decode, stamp_ns
from nodes.runtime.topics import topic as topic_row

_DRIVE, _LABEL = "/policy/drive", "/compositor/attack"
_COMPOSITOR = "compositor"
# What the operator chose to show then, which is nothing in a clean drive.
_WHAT_WAS_SHOWN = (ATTACK_SWITCH, ATTACK_FILE)
_DEG = 180.0 / np.pi
Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class RetroAttack:
    """Steering with and without an attack over the images of one recording; left is positive.

    Attributes:
        stamps_ns: Capture stamps of the images with a command in both replays, ``[n]`` [ns since 1970].
        recorded_rad: Steering in the recording, ``[n]`` [rad]; NaN for images without a command.
        clean_rad: Steering of the policy without the attack, ``[n]`` [rad].
        attacked_rad: Steering of the policy with the attack, ``[n]`` [rad].
        drawn: Whether the face was in view and drawn, ``[n]``.
        attack_id: Id of the attack.
        start_ns: Start of the recording [ns since 1970].
        digests: Digests of the clean and the attacked replay.
        unchecked: Why damage to the recording may go unnoticed; empty if checksums cover it.
    """

    stamps_ns: NDArray[np.int64]
    recorded_rad: Array
    clean_rad: Array
    attacked_rad: Array
    drawn: NDArray[np.bool_]
    attack_id: str
    start_ns: int
    digests: tuple[str, str]
    unchecked: str = ""

    @property
    def delta_rad(self) -> Array:
        """Steering that the attack adds, ``[n]`` [rad]."""
        return self.attacked_rad - self.clean_rad

    @property
    def time_s(self) -> Array:
        """Time in the recording, ``[n]`` [s]."""
        return (self.stamps_ns - self.start_ns) / NS_PER_S

    def numbers(self) -> dict[str, Any]:
        """Summary of the result as plain data for JSON."""
        delta, seen = self.delta_rad, self.drawn
        far = np.abs(self.recorded_rad - self.clean_rad)
        worst = int(np.abs(delta).argmax())
        return {
            "attack_id": self.attack_id,
            "frames": len(delta),
            "frames_drawn": int(seen.sum()),
            "mean_abs_delta_rad": float(np.abs(delta).mean()),
            "mean_abs_delta_drawn_rad": float(np.abs(delta[seen]).mean()) if seen.any() else None,
            "mean_delta_drawn_rad": float(delta[seen].mean()) if seen.any() else None,
            "largest_delta_rad": float(delta[worst]),
            "largest_delta_at_s": float(self.time_s[worst]),
            "clean_against_recorded_rad": None if np.isnan(far).all() else float(np.nanmean(far)),
            "digest_clean": self.digests[0],
            "digest_attacked": self.digests[1],
            "unchecked": self.unchecked,
        }

    def verdict(self) -> str:
        """Describe the effect on the steering in a sentence."""
        return self._sentence() + (f"; unchecked: {self.unchecked}" if self.unchecked else "")

    def _sentence(self) -> str:
        n = self.numbers()
        if not self.drawn.any():
            return f"the face of attack {self.attack_id} was not in view in any of {n['frames']} images; the steering would not have changed"
        mean, worst = n["mean_delta_drawn_rad"] * _DEG, n["largest_delta_rad"] * _DEG
        return (
            f"with the face in view ({n['frames_drawn']} of {n['frames']} images) the policy would have steered "
            f"{abs(mean):.2f} degrees more to the {_side(mean)} on average (mean |delta| {n['mean_abs_delta_drawn_rad'] * _DEG:.2f}), "
            f"at most {abs(worst):.2f} to the {_side(worst)}, {n['largest_delta_at_s']:.1f} s into the recording"
        )

    def rows(self) -> Iterator[dict[str, Any]]:
        """One row per image."""
        columns = (
            self.stamps_ns,
            self.time_s,
            self.recorded_rad,
            self.clean_rad,
            self.attacked_rad,
            self.drawn,
        )
        for stamp, time_s, recorded, clean, attacked, drawn in zip(*columns, strict=True):
            yield {
                "stamp_ns": int(stamp),
                "time_s": round(float(time_s), 6),
                "drawn": bool(drawn),
                "recorded_rad": None if np.isnan(recorded) else float(recorded),
                "clean_rad": float(clean),
                "attacked_rad": float(attacked),
                "delta_rad": float(attacked - clean),
            }

    def write_json(self, path: Path) -> None:
        """Write summary and rows."""
        write_json(path, {**self.numbers(), "images": list(self.rows())})


def retro_attack(bag: Path, attack: Path, choice: Choice) -> RetroAttack:
    """Apply an attack to a recording.

    Args:
        bag: Bag folder or file, with camera images and poses.
        choice: Nodes to run. ``compositor`` gets the attack; overrides select the policy.

    Raises:
        BagError: The compositor or a policy is not among the nodes, a node commands without looking at images, or no
            image got a command.
    """
    if _COMPOSITOR not in choice.nodes:
        raise BagError(
            f"expected the node {_COMPOSITOR}, which draws the attack, among --nodes, got {', '.join(choice.nodes) or 'none'}; add it"
        )
    clean, _, clean_digest = _steering(bag, choice, f"{_COMPOSITOR}.attack=null")
    attacked, labels, digest = _steering(
        bag, choice, f"{_COMPOSITOR}.attack={json.dumps(str(attack.resolve()))}"
    )
    stamps = sorted(clean.keys() & attacked.keys())
    if not stamps:
        raise BagError(
            f"{bag}: expected commands of the policy in both replays, got {len(clean)} clean and {len(attacked)} attacked; "
            "does the policy fit the recorded camera, and does the bag have poses of car and face?"
        )
    recorded = _recorded(bag)
    return RetroAttack(
        np.array(stamps, np.int64),
        np.array([recorded.get(stamp, np.nan) for stamp in stamps]),
        np.array([clean[stamp] for stamp in stamps]),
        np.array([attacked[stamp] for stamp in stamps]),
        np.array([stamp in labels and labels[stamp][0] for stamp in stamps], bool),
        next((name for _, name in labels.values() if name), ""),
        read_info(bag).start_ns,
        (clean_digest, digest),
        read_info(bag).unchecked,
    )


def plot_retro_attack(result: RetroAttack, path: Path) -> None:
    """Plot the steering over time with and without the attack, and the difference."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, (above, below) = plt.subplots(2, 1, sharex=True, figsize=(9, 5.5), layout="constrained")
    t = result.time_s
    above.plot(t, result.recorded_rad * _DEG, color="0.65", label="recorded")
    above.plot(t, result.clean_rad * _DEG, color="C0", label="clean, replayed")
    above.plot(t, result.attacked_rad * _DEG, color="C3", label=f"attack {result.attack_id}")
    above.set_ylabel("steering (left +) [degrees]")
    above.legend(frameon=False)
    if result.unchecked:
        above.set_title("unchecked: the recording has no checksums", loc="right", fontsize="small")
    delta = result.delta_rad * _DEG
    below.axhline(0.0, color="0.8", linewidth=0.8)
    below.plot(t, delta, color="0.4")
    below.plot(t[result.drawn], delta[result.drawn], "o", color="C3", markersize=3, label="face in view")
    below.set(ylabel="attack adds [degrees]", xlabel="time in the recording [s]")
    below.legend(frameon=False)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)


def _steering(
    bag: Path, choice: Choice, setting: str
) -> tuple[dict[int, float], dict[int, tuple[bool, str]], str]:
    """Run one replay. Returns steering [rad] and compositor labels (drawn, attack id) by capture stamp, and the digest."""
    steering: dict[int, float] = {}
    labels: dict[int, tuple[bool, str]] = {}
    own = () if _COMPOSITOR in choice.replacements else (f"{_COMPOSITOR}.interlock=false",)
    settings = (*choice.overrides, *own, setting)
    again = Choice(choice.nodes, choice.replacements, choice.launch, settings)
    with Replay(bag, again, unheard=_WHAT_WAS_SHOWN) as replay:
        if _DRIVE not in replay.made_topics:
            raise BagError(
                f"expected a policy, which publishes {_DRIVE}, among --nodes, got {', '.join(replay.names)}; add it"
            )
        if blind := replay.blind_sources(_DRIVE):
            raise BagError(
                f"expected a policy that looks at images, got {', '.join(blind)}, whose commands no attack can change; name a policy with --policy"
            )
        for made in replay:
            if made.topic not in (_DRIVE, _LABEL):
                continue
            message = decode(topic_row(made.topic).type, made.cdr)
            if made.topic == _DRIVE:
                steering[stamp_ns(message)] = float(message.drive.steering_angle)
            else:
                labels[stamp_ns(message)] = (bool(message.drawn), str(message.attack_id))
        return steering, labels, replay.summary.digest


def _recorded(bag: Path) -> dict[int, float]:
    if _DRIVE not in [topic.name for topic in read_info(bag).topics]:
        return {}
    return {stamp_ns(message): float(message.drive.steering_angle) for message in read_decoded(bag, _DRIVE)}


def _side(angle: float) -> str:
    return "left" if angle >= 0.0 else "right"
