import json
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Literal

import numpy as np
import pytest
import torch
import torch.nn.functional as F

from advnerf_core.driving.dynamics import Ackermann
from advnerf_core.driving.expert import Expert
from advnerf_core.driving.path import Path as Track
from advnerf_core.driving.rollout import drive
from advnerf_core.geometry import Pinhole, VehicleState, camera_mount, planar_pose
from advnerf_core.learning import imitation
from advnerf_core.learning.augment import Changes
from advnerf_core.learning.fit import DivergedError, FitConfig, Gradients, fit, mean_absolute_error
from advnerf_core.learning.frames import Frames, FrameSet, FrameStore, FrameStoreError
from advnerf_core.learning.imitation import TrainedPolicy, train_policy
from advnerf_core.learning.recipe import ImitationConfig, SourcePlan, recovery_states
from advnerf_core.learning.sources import RenderedSource, SceneSource, steer_with
from advnerf_core.parallel import set_thread_count
from advnerf_core.policies.architecture import Architecture
from advnerf_core.policies.number_type import layer_type
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.policies.view import PolicyView

EXAMPLE = Path(__file__).parents[3] / "examples" / "my_architecture.py"
TRACK = Track.rounded_square(4.0, 1.1)
VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0))
T_CAR_FROM_CAMERA = camera_mount(0.30, 0.0, 0.20, np.deg2rad(10.0))
DYNAMICS = Ackermann(0.25, 0.8, 0.1)
EXPERT = Expert(TRACK)
TINY = ImitationConfig(
    first_steps=3, round_steps=3, naive_steps=3, batch_size=4, dagger_rounds=1, holdout_every=2
)


def paint_floor(states: np.ndarray, pinhole: Pinhole) -> np.ndarray:
    """Ray-cast images ``[B, H, W, 3]`` in 0..1 of a grey floor with the track's tape on it, under a blue sky."""
    return np.stack([_paint(tuple(map(float, state)), pinhole) for state in states])


@cache
def _paint(state: tuple[float, float, float], pinhole: Pinhole) -> np.ndarray:
    T = planar_pose(*state) @ T_CAR_FROM_CAMERA
    rays = pinhole.directions() @ T[:3, :3].T
    down = rays[..., 2] < -0.02
    offset = np.ones(rays.shape[:2])
    floor_rays = rays[down]
    offset[down] = np.abs(TRACK.project(T[:2, 3] + T[2, 3] / -floor_rays[:, 2:] * floor_rays[:, :2]).cte_m)
    tape = np.clip((0.035 - offset) / 0.02, 0.0, 1.0)[..., None]
    floor = 0.5 * (1.0 - tape) + np.array([0.1, 0.8, 0.3]) * tape
    return np.where(down[..., None], floor, [0.4, 0.5, 0.9])


def prepare(states: np.ndarray):
    background = torch.from_numpy(paint_floor(states, VIEW.pinhole)).permute(0, 3, 1, 2).float()

    def show(texture: np.ndarray | None) -> torch.Tensor:
        image = background.clone()
        if texture is not None:
            in_view = torch.from_numpy(np.asarray(states)[:, 0] > 0.0)
            image[in_view, :, 5:9, 90:94] = torch.from_numpy(texture).permute(2, 0, 1)
        return image

    return show


class FloorScene:
    """A scene that steps its own car over the painted floor."""

    def __init__(self) -> None:
        self.state = np.zeros(3)

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> None:
        self.state = np.array([x_m, y_m, yaw_rad])

    def step(self, steering_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        car = Ackermann(0.25, speed_mps, duration_s)
        self.state = car.step(torch.from_numpy(self.state)[None], torch.tensor([steering_rad])).numpy()[0]
        return VehicleState(*map(float, self.state))

    def observe(self, depth: Literal[False]) -> tuple[np.ndarray, None]:
        return self.observe_at(*map(float, self.state), depth=depth)

    def observe_at(
        self, x_m: float, y_m: float, yaw_rad: float, depth: Literal[False]
    ) -> tuple[np.ndarray, None]:
        image = paint_floor(np.array([[x_m, y_m, yaw_rad]]), VIEW.camera)[0]
        return (image * 255).astype(np.uint8), None


def overlay(rgb: np.ndarray, state: np.ndarray, texture: np.ndarray) -> np.ndarray:
    painted = rgb.copy()
    if state[0] > 0.0:
        painted[60:64, 100:104] = (texture * 255).astype(np.uint8)
    return painted


def random_texture(rng: np.random.Generator) -> np.ndarray:
    return (1.0 / (1.0 + np.exp(-5.0 * rng.standard_normal((4, 4, 3))))).astype(np.float32)


def _plans() -> list[SourcePlan]:
    rendered = RenderedSource("rendered", prepare, DYNAMICS, random_texture, batch_size=4)
    scene = SceneSource("scene", FloorScene(), VIEW, 0.8, 0.1, overlay, random_texture)
    return [SourcePlan(rendered, 20, drives=2, drive_steps=3), SourcePlan(scene, 4, drives=2, drive_steps=2)]


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> TrainedPolicy:
    """What the recipe gives when nothing interrupts it."""
    return train_policy(TINY, _plans(), EXPERT, VIEW, tmp_path_factory.mktemp("whole"))


def test_recovery_states_cover_the_range() -> None:
    states = recovery_states(TRACK, 400, np.random.default_rng(0), 0.35, 0.45)
    at = TRACK.project(states[:, :2])
    assert 0.3 < np.abs(at.cte_m).max() < 0.3501
    heading = (states[:, 2] - at.heading_rad + np.pi) % (2 * np.pi) - np.pi
    assert 0.4 < np.abs(heading).max() < 0.4501
    assert np.histogram(at.s_m, bins=8, range=(0, TRACK.length_m))[0].min() > 40


def test_sources_show_textures_only_where_they_are_in_view() -> None:
    states = np.array([[-1.0, -2.0, 0.0], [1.0, -2.0, 0.0]])
    rng = np.random.default_rng(0)
    rendered, scene = (plan.source for plan in _plans())
    seen = rendered.look(states, rng)
    assert seen.textured.tolist() == [False, False, True]
    np.testing.assert_array_equal(seen.states, states[[0, 1, 1]])
    looked = scene.look(states, rng)
    assert looked.textured.tolist() == [False, False, True]
    assert not np.array_equal(looked.images[1], looked.images[2])
    # The two domains show the same plain view, up to resampling.
    assert np.abs(looked.images[0].astype(float) - seen.images[0]).mean() < 2.0


def test_drives_follow_the_policy_and_stop_when_told() -> None:
    starts = np.array([[-1.0, -2.0, 0.0], [0.2, -2.0, 0.0]])
    for plan in _plans():
        seen = plan.source.drive(
            lambda images: np.full(len(images), 0.1),
            starts,
            3,
            lambda s: s[:, 0] < 0.3,
            np.random.default_rng(0),
        )
        plain = seen.states[~seen.textured]
        assert len(plain) == 3 + 2  # the second drive passes x = 0.3 after two steps
        first = plain[plain[:, 0] < 0.0]
        moved = DYNAMICS.step(torch.from_numpy(first[:1]), torch.tensor([0.1], dtype=torch.float64)).numpy()
        np.testing.assert_allclose(first[1], moved[0], atol=1e-7)


def test_recipe_writes_both_policies_and_repeats_itself(tmp_path: Path, whole: TrainedPolicy) -> None:
    heard: list[float] = []
    result = train_policy(
        TINY, _plans(), EXPERT, VIEW, tmp_path / "a", lambda share, text, learned=None: heard.append(share)
    )
    assert result.sha256 == whole.sha256
    assert result.naive_sha256 == whole.naive_sha256 != result.sha256
    loaded = load_policy(result.path, result.sha256)
    assert loaded.view == VIEW
    assert loaded.metadata["random_textures"] is True
    assert heard == sorted(heard)
    assert heard[-1] == pytest.approx(1.0)
    cached = train_policy(TINY, _plans(), EXPERT, VIEW, tmp_path / "a")
    assert (cached.sha256, cached.frames) == (result.sha256, result.frames)
    with pytest.raises(FrameStoreError, match="same settings"):
        train_policy(replace(TINY, seed=1), _plans(), EXPERT, VIEW, tmp_path / "a")


@pytest.mark.parametrize("killed_in", ["drive0-scene", "dagger0", "naive"])
def test_killed_recipe_goes_on_to_the_same_policy(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, whole: TrainedPolicy, killed_in: str
) -> None:
    append, original_fit = FrameStore.append, imitation.fit

    def dying_append(self: FrameStore, name: str, frames: Frames) -> None:
        if name == killed_in:
            raise KeyboardInterrupt
        append(self, name, frames)

    def dying_fit(policy, frames, config, checkpoint, report, number_type):
        if checkpoint.name.startswith(killed_in):
            original_fit(
                policy, frames, replace(config, checkpoint_every=1), None, _die_after(2), number_type
            )
        original_fit(policy, frames, config, checkpoint, report, number_type)

    def _die_after(steps: int):
        def report(step: int, loss: float) -> None:
            if step >= steps:
                raise KeyboardInterrupt

        return report

    with monkeypatch.context() as patch:
        patch.setattr(FrameStore, "append", dying_append)
        patch.setattr(imitation, "fit", dying_fit)
        with pytest.raises(KeyboardInterrupt):
            train_policy(TINY, _plans(), EXPERT, VIEW, tmp_path / "killed")
    resumed = train_policy(TINY, _plans(), EXPERT, VIEW, tmp_path / "killed")
    assert (resumed.sha256, resumed.naive_sha256) == (whole.sha256, whole.naive_sha256)


def _small_set() -> FrameSet:
    states = recovery_states(TRACK, 24, np.random.default_rng(0), 0.2, 0.2)
    images = (paint_floor(states, VIEW.pinhole) * 255).astype(np.uint8)
    labels = EXPERT.steer_states(states).astype(np.float32)
    return FrameSet([Frames(images, states, labels, np.zeros((24, 0), np.float32), np.zeros(24, bool))])


@pytest.mark.parametrize("number_type", [torch.float32, torch.bfloat16])
def test_fit_resumes_to_the_bit(tmp_path: Path, number_type: torch.dtype) -> None:
    frames, config = _small_set(), FitConfig(steps=6, batch_size=8, checkpoint_every=3)
    torch.manual_seed(0)
    whole = PilotNet()
    fit(whole, frames, config, tmp_path / "whole.safetensors", number_type=number_type)
    torch.manual_seed(0)
    interrupted = PilotNet()
    calls = 0
    batch = frames.batch

    def failing_batch(rows):
        nonlocal calls
        calls += 1
        if calls > 5:
            raise OSError("the disk went away")
        return batch(rows)

    frames.batch = failing_batch  # type: ignore[method-assign]
    with pytest.raises(OSError, match="went away"):
        fit(interrupted, frames, config, tmp_path / "part.safetensors", number_type=number_type)
    frames.batch = batch  # type: ignore[method-assign]
    resumed = PilotNet()  # other weights: all must come from the checkpoint
    fit(resumed, frames, config, tmp_path / "part.safetensors", number_type=number_type)
    for a, b in zip(whole.parameters(), resumed.parameters(), strict=True):
        assert torch.equal(a, b)
    with pytest.raises(FrameStoreError, match="same settings"):
        fit(resumed, frames, replace(config, steps=7), tmp_path / "part.safetensors")
    (tmp_path / "part.safetensors").write_bytes(b"rubbish")
    with pytest.raises(FrameStoreError, match="delete it to start again"):
        fit(resumed, frames, config, tmp_path / "part.safetensors")


def test_a_training_that_diverges_says_so_and_writes_no_checkpoint_of_it(tmp_path: Path) -> None:
    class Growing(PilotNet):
        def forward(self, *inputs):
            return super().forward(*inputs) / next(self.parameters()).detach().mul(0.0).sum()

    frames, config = _small_set(), FitConfig(steps=6, batch_size=8, checkpoint_every=1, learning_rate=0.5)
    with pytest.raises(
        DivergedError, match=r"got (nan|inf) at step 1 of 6: .* Lower the learning rate of 0\.5"
    ):
        fit(Growing(), frames, config, tmp_path / "a.safetensors")
    assert not list(tmp_path.iterdir())


def test_weights_that_the_last_step_spoils_are_no_policy() -> None:
    frames = _small_set()
    config = FitConfig(steps=1, batch_size=8, learning_rate=1e38, warm_up_steps=0, weight_decay=1e10)
    with pytest.raises(DivergedError, match=r"got (nan|inf) at its last step"):
        fit(PilotNet(), frames, config)


def test_fit_learns_in_either_number_type() -> None:
    frames = _small_set()
    for number_type in (torch.float32, torch.bfloat16):
        torch.manual_seed(0)
        policy = PilotNet()
        before = mean_absolute_error(policy, frames)
        fit(policy, frames, FitConfig(steps=40, batch_size=12, learning_rate=3e-3), number_type=number_type)
        assert all(each.dtype == torch.float32 for each in policy.parameters())
        assert mean_absolute_error(policy, frames) < 0.5 * before


def test_halves_of_a_batch_have_the_gradient_of_the_whole() -> None:
    frames, config = _small_set(), FitConfig(steps=1, batch_size=10)
    torch.manual_seed(0)
    policy = PilotNet().to(torch.float64)
    rng = np.random.default_rng([config.seed, 0])
    images, labels, _ = frames.batch(frames.training[rng.integers(0, len(frames.training), 10)])
    inputs = (
        torch.from_numpy(Changes.drawn(10, config.augment, rng).applied(images)).permute(0, 3, 1, 2).double()
    )
    output = policy(inputs)
    loss = F.huber_loss(output, torch.from_numpy(labels).double(), delta=config.huber_rad)
    expected = torch.autograd.grad(loss / config.huber_rad**2, list(policy.parameters()))
    squares = (output.detach() - torch.from_numpy(labels)).square()
    gradients = Gradients(policy.float(), config, torch.float32)
    for threads in (1, 2):
        set_thread_count(threads)
        try:
            error, found = gradients.of_step(frames, 0)
        finally:
            set_thread_count(0)
        assert error == pytest.approx(float(squares.mean()), rel=1e-4)
        for one, other in zip(found.values(), expected, strict=True):
            torch.testing.assert_close(one.double(), other, rtol=1e-3, atol=1e-5)


def test_the_machine_says_which_number_type_it_multiplies(tmp_path: Path) -> None:
    for flags, expected in (
        ("fpu avx512f", torch.float32),
        ("fpu avx512_bf16", torch.bfloat16),
        ("amx_bf16", torch.bfloat16),
    ):
        processor = tmp_path / flags.replace(" ", "_")
        processor.write_text(f"model name\t: A\nflags\t\t: {flags}\n\nflags\t\t: other\n")
        assert layer_type(processor) == expected
    assert layer_type(tmp_path / "absent") == torch.float32


@pytest.mark.slow
def test_learned_policy_drives_three_laps(tmp_path: Path) -> None:
    rendered = RenderedSource("rendered", prepare, DYNAMICS, batch_size=8)
    config = ImitationConfig(first_steps=400, round_steps=150, dagger_rounds=1)
    result = train_policy(config, [SourcePlan(rendered, 1000, drives=8)], EXPERT, VIEW, tmp_path)
    policy = load_policy(result.path).policy
    start = torch.tensor([[-1.1, -2.0, 0.0]], dtype=torch.float64)
    steps = int(3 * TRACK.length_m / 0.08)
    rollout = drive(policy, lambda s: prepare(s[:, :3].numpy())(None), DYNAMICS, start, steps)
    ctes = np.abs(TRACK.project(rollout.states[1:, 0, :2].numpy()).cte_m)
    assert ctes.max() < 0.4
    assert ctes.mean() < 0.08


def test_steer_with_runs_on_uint8_images() -> None:
    assert steer_with(PilotNet())(np.zeros((2, 66, 200, 3), np.uint8)).shape == (2,)


@pytest.mark.parametrize(
    "name", ["resnet", "vit_tiny", f"{EXAMPLE}:Mixer"], ids=["resnet", "vit", "of a user"]
)
def test_the_recipe_trains_any_architecture(name: str, tmp_path: Path) -> None:
    config = replace(TINY, architecture=Architecture(name))
    done = train_policy(config, _plans(), EXPERT, VIEW, tmp_path / "a")
    loaded = load_policy(done.path)
    assert type(loaded.policy).__name__ == {"resnet": "ResNet", "vit_tiny": "VisionTransformer"}.get(
        name, "Mixer"
    )
    assert str(EXAMPLE.parent) not in json.dumps(loaded.metadata)  # the same file on every machine
    assert train_policy(config, _plans(), EXPERT, VIEW, tmp_path / "a").sha256 == done.sha256
    with pytest.raises(FrameStoreError, match="same settings"):
        train_policy(TINY, _plans(), EXPERT, VIEW, tmp_path / "a")
