import numpy as np
import pytest
from pydantic import ValidationError

from advnerf_core.scene.fidelity import Effect, PicturePairs, SceneAgreement, agreement, judge
from advnerf_core.scene.gate_limits import GateLimits

RNG = np.random.default_rng(0)
REAL = RNG.integers(40, 200, (12, 66, 200, 3)).astype(np.uint8)
STEERING = np.linspace(-0.3, 0.3, 12)


def test_agreement_of_a_known_offset_in_closed_form():
    found = agreement(list(REAL), list(REAL + 5), STEERING, STEERING + 0.02)
    numbers = found.summary()
    assert numbers["psnr_db"] == pytest.approx(20 * np.log10(255 / 5))
    assert numbers["steering"] == pytest.approx(0.02)
    assert numbers["steering_bias"] == pytest.approx(0.02)
    assert numbers["correlation"] == pytest.approx(1.0)


def test_each_limit_alone_refuses_and_says_why():
    good = agreement(list(REAL), list(REAL + 5), STEERING, STEERING + 0.02)
    assert judge(good, GateLimits()).passed
    for limits, why in (
        ({"psnr_db": 40.0}, "PSNR 34.15 dB, at least 40"),
        ({"steering": 0.01}, "steering difference 0.0200, at most 0.01"),
        ({"views": 13}, "12 pictures, at least 13"),
        ({"ssim": 1.0}, "SSIM"),
    ):
        verdict = judge(good, GateLimits(**limits), "views of mine")
        assert not verdict.passed
        assert len(verdict.reasons) == 1
        assert verdict.reasons[0].startswith("views of mine: ")
        assert why in verdict.reasons[0]
    turned = agreement(list(REAL), list(REAL), STEERING, -STEERING)
    assert any(
        "correlation of the steering -1.000" in reason for reason in judge(turned, GateLimits()).reasons
    )


def test_constant_steering_correlates_only_with_itself():
    flat, ones = np.zeros(12), np.ones(12)
    make = lambda a, b: SceneAgreement(ones, ones, a, b)  # noqa: E731
    assert make(flat, flat).correlation == 1.0
    assert make(flat, STEERING).correlation == 0.0


def test_the_share_of_an_effect_that_survives_is_the_least_squares_slope():
    learned = RNG.normal(size=50)
    noise = RNG.normal(size=50)
    noise -= learned * (noise @ learned) / (learned @ learned)  # orthogonal, so the slope is known
    effect = Effect(learned, 0.7 * learned + 0.1 * noise)
    assert effect.retained == pytest.approx(0.7)
    assert effect.residual == pytest.approx(0.1 * noise)
    assert Effect(np.zeros(3), np.ones(3)).retained == 0.0


def test_bad_input_is_refused():
    with pytest.raises(ValueError, match="as many learned as real"):
        agreement(list(REAL), list(REAL[1:]), STEERING, STEERING)
    with pytest.raises(ValueError, match="finite"):
        agreement(list(REAL), list(REAL), STEERING, STEERING * np.nan)
    with pytest.raises(ValueError, match="one effect per view"):
        Effect(np.zeros(2), np.zeros(3))
    with pytest.raises(ValueError, match=r"\[N, H, W, 3\]"):
        PicturePairs("x", REAL, REAL[:3])
    with pytest.raises(ValidationError):
        GateLimits(psnr=30)
