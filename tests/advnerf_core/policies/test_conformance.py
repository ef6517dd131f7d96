import random
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from advnerf_core.geometry import Pinhole
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.conformance import FAILURE, OK, check_policy, require_steady
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.tracker import TrackedTrajectory
from advnerf_core.policies.view import PolicyView

VIEW = PolicyView(Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0), width=40, height=22)
DECLARED = PolicyContract(VIEW)


def reference(count=64):
    """Scenes of a coloured blob left or right of the middle; an expert steers to where it is, harder the redder it is."""
    rng = np.random.default_rng(0)
    images = rng.integers(60, 90, (count, 22, 40, 3)).astype(np.uint8)
    columns, reds = rng.integers(2, 34, count), rng.integers(120, 255, count)
    for image, column, red in zip(images, columns, reds, strict=True):
        image[6:14, column : column + 5] = (red, 40, 40)
    redness = (reds / 255.0 - 0.36) / 0.64
    steering = 0.25 * (19.5 - (columns + 2)) / 20.0 * redness + rng.normal(0.0, 0.01, count)
    return images, steering


class Seer(nn.Module):
    """What the expert does, from the image; smooth, and bounded as PilotNet is."""

    def __init__(self):
        super().__init__()
        self.gain = nn.Parameter(torch.tensor(1.0))

    def forward(self, images):
        red = nn.functional.softplus(20.0 * (images[:, 0] - images[:, 2] - 0.2)) / 20.0
        weight = torch.linspace(1.0, -1.0, images.shape[-1])
        return 0.3 * torch.tanh(self.gain * 0.036 * (red * weight).sum(dim=(1, 2)))


class Around(nn.Module):
    """The seer with something done before and after it."""

    def __init__(self, before=lambda x: x, after=lambda y: y):
        super().__init__()
        self.seer, self.before, self.after = Seer(), before, after

    def forward(self, images):
        return self.after(self.seer(self.before(images)))


def findings(network, contract=DECLARED, **told):
    return {f.name: f for f in check_policy(adapt(network, contract), *reference(), **told)}


def around(before=lambda x: x, after=lambda y: y):
    return Around(before, after).eval()


def test_an_honest_policy_passes_every_check():
    found = findings(around())
    names = ["mode", "input", "finite", "answer", "repeatable", "batch", "gradient", "range", "expert"]
    assert list(found) == names
    assert {f.verdict for f in found.values()} == {OK}, found
    with pytest.raises(ValueError, match="at least 4 images"):
        check_policy(adapt(around(), DECLARED), reference()[0][:2])


def swapped(x):
    return x[:, [2, 1, 0]]


@pytest.mark.parametrize(
    ("before", "after", "advice", "contract"),
    [
        (swapped, lambda y: y, "takes BGR for RGB: set colour_space = 'BGR'", {}),
        (
            lambda x: x / 255,
            lambda y: y,
            "expects values of 0..255, but is given 0..1: set value_max = 255",
            {},
        ),
        (
            lambda x: x,
            lambda y: y,
            "expects values of 0..1, but is given 0..255: set value_max = 1",
            {"value_max": 255.0},
        ),
        (
            lambda x: x,
            lambda y: y * 180 / np.pi,
            "steers in degrees for radians: set output_unit = 'deg'",
            {},
        ),
        (
            lambda x: x,
            lambda y: y,
            "steers in radians for degrees: set output_unit = 'rad'",
            {"output_unit": "deg"},
        ),
        (
            lambda x: x,
            lambda y: -y,
            "steers positive to the right, not to the left: set positive = 'right'",
            {},
        ),
        (lambda x: swapped(x) / 255, lambda y: y, "0..255, but is given 0..1 and takes BGR for RGB", {}),
        (swapped, lambda y: -y, "takes BGR for RGB and steers positive to the right", {}),
    ],
)
def test_a_lie_is_recognised_and_named(before, after, advice, contract):
    found = findings(around(before, after), replace(DECLARED, **contract))
    assert found["expert"].verdict == FAILURE, found
    assert advice in found["expert"].text


def test_the_declaration_that_is_advised_makes_it_right():
    network = around(lambda x: swapped(x) / 255, lambda y: -y * 180 / np.pi)
    truth = replace(DECLARED, colour_space="BGR", value_max=255.0, output_unit="deg", positive="right")
    assert findings(network, truth)["expert"].verdict == OK
    assert findings(network)["expert"].verdict == FAILURE


def test_a_policy_for_another_place_is_no_liar_but_a_warning():
    found = findings(around(lambda x: x.flip(2).roll(13, 3)[:, [1, 0, 2]] * 0.3 + 0.1))
    assert found["expert"].verdict == "warning"
    assert "check the crop" in found["expert"].text


def test_without_an_expert_degrees_are_still_too_much():
    found = check_policy(adapt(around(after=lambda y: 60 * y), DECLARED), reference()[0])
    assert found[-1].name == "range"
    assert "output_unit = 'deg'" in found[-1].text


class Dropping(nn.Module):
    def __init__(self, always):
        super().__init__()
        self.seer, self.drop, self.always = Seer(), nn.Dropout(0.5), always

    def forward(self, images):
        images = nn.functional.dropout(images, 0.5, training=True) if self.always else self.drop(images)
        return self.seer(images)


def test_training_mode_and_dropout():
    found = findings(Dropping(always=False))
    assert "in training mode, with Dropout at work; call .eval()" in found["mode"].text
    assert "dropout or noise is left on" in found["repeatable"].text
    found = findings(Dropping(always=True).eval())
    assert found["mode"].verdict == OK
    assert found["repeatable"].verdict == FAILURE
    assert "random" in found["repeatable"].text


class Remembering(nn.Module):
    def __init__(self):
        super().__init__()
        self.seer, self.last = Seer(), 0.0

    def forward(self, images):
        steering = self.seer(images) + 0.5 * self.last
        self.last = float(steering.mean().detach())
        return steering


def test_a_hidden_memory():
    found = findings(Remembering().eval())
    assert "declared stateless, but the output depends on the images before" in found["repeatable"].text


def test_an_image_that_depends_on_its_batch():
    found = findings(around(lambda x: x - x.mean(0, keepdim=True)))
    assert found["batch"].verdict == FAILURE
    assert "differently in a batch than alone" in found["batch"].text


class Flat(nn.Module):
    def __init__(self, height, width):
        super().__init__()
        self.linear, self.size = nn.Linear(3 * height * width, 1), (height, width)

    def forward(self, images):
        return self.linear(images.flatten(1))


@pytest.mark.parametrize(
    ("network", "advice"),
    [
        (Flat(66, 200), "set width = 200 and height = 66 in the view"),
        (Around(lambda x: x.permute(0, 3, 1, 2) if x.shape[-1] == 3 else 1 / 0), "set layout = 'NHWC'"),
        (nn.Sequential(nn.Flatten(), nn.Linear(2640, 2)), "return the column that steers"),
        (nn.Sequential(nn.Flatten(), nn.Linear(7, 1)), "the size it was trained with"),
    ],
)
def test_a_wrong_size_layout_or_output(network, advice):
    found = findings(network.eval())
    assert list(found) == ["mode", "input"]
    assert found["input"].verdict == FAILURE
    assert advice in found["input"].text


def test_nan():
    found = findings(around(lambda x: x / x.std(dim=(1, 2, 3), keepdim=True)))
    assert list(found)[-1] == "finite"
    assert "black and a white image is NaN" in found["finite"].text


@pytest.mark.parametrize(
    ("before", "after", "sentence"),
    [
        (lambda x: x.detach(), lambda y: y.detach(), "no gradient reaches the image"),
        (lambda x: torch.round(x * 255) / 255, lambda y: y, "the gradient is zero everywhere"),
        (lambda x: x, lambda y: torch.round(y * 50) / 50 + 0 * y, "the gradient is zero everywhere"),
        (lambda x: x + 0.0 * (0.0 * x).sqrt(), lambda y: y, "the gradient is NaN or infinite"),
        (lambda x: 0.5 * x + 0.5 * x.detach(), lambda y: y, "differs from finite differences by"),
    ],
)
def test_no_gradient(before, after, sentence):
    found = findings(around(before, after))
    assert found["gradient"].verdict != OK
    assert sentence in found["gradient"].text
    assert findings(around(before, after), replace(DECLARED, differentiable=False))["gradient"].verdict == OK


def test_a_network_that_leaves_torch_fails_the_check_of_the_gradient():
    found = findings(around(lambda x: torch.from_numpy(x.numpy())))
    assert found["gradient"].verdict == FAILURE
    assert (
        "the network fails: RuntimeError: Can't call numpy() on Tensor that requires grad"
        in found["gradient"].text
    )
    # In place it changes a copy of the picture.
    assert findings(around(lambda x: x.mul_(1.0)))["gradient"].verdict == OK


def test_a_constant_output():
    found = findings(around(after=lambda y: 0 * y + 0.1))
    assert "steers 0.1000 rad whatever it sees" in found["range"].text


def test_a_black_box_is_told_every_method_that_can_attack_it():
    closed = replace(DECLARED, differentiable=False)
    found = findings(around(), closed, methods=("random", "cem"))
    assert found["gradient"].text == "declared a black box: attacked without a gradient (random, cem)"
    assert findings(around(), closed)["gradient"].text == "declared a black box: attacked without a gradient"


def test_a_network_of_yuv_that_is_declared_rgb_is_recognised():
    back = torch.tensor(
        [
            [1.0, 0.0, 1.0 / 0.877],
            [1.0, -0.114 / 0.587 / 0.492, -0.299 / 0.587 / 0.877],
            [1.0, 1.0 / 0.492, 0.0],
        ]
    )

    def from_yuv(x):
        return torch.einsum("kc,bchw->bkhw", back, x - torch.tensor([0.0, 0.5, 0.5]).view(1, 3, 1, 1))

    found = findings(around(from_yuv))
    assert "takes YUV for RGB: set colour_space = 'YUV'" in found["expert"].text
    assert findings(around(from_yuv), replace(DECLARED, colour_space="YUV"))["expert"].verdict == OK


class Sees(nn.Module):
    """A network that a declaration of two images and waypoints fits: the seer on the newest, on a straight line."""

    def forward(self, images):
        side = Seer()(images[:, 1])
        ahead = torch.tensor([0.4, 0.8], dtype=images.dtype)
        return torch.stack([ahead + 0.0 * side[:, None], ahead * side[:, None]], dim=2)


def test_waypoints_and_stacks_are_checked_too():
    tracked = TrackedTrajectory(times_s=(0.5, 1.0), lookahead_m=0.4, wheelbase_m=0.2)
    contract = replace(DECLARED, frames=FrameStack(count=2, axis="time"), trajectory=tracked)
    found = findings(Sees().eval(), contract)
    assert {each.verdict for each in found.values()} == {OK}
    assert "waypoints up to 0.80 m ahead" in found["answer"].text
    assert "is not used by searches and experiments" in found["answer"].text
    assert (
        "set positive = 'left'" in findings(Sees().eval(), replace(contract, positive="right"))["expert"].text
    )
    short = replace(contract, trajectory=tracked.model_copy(update={"wheelbase_m": 50.0}))
    assert (
        "check that the waypoints are in metres"
        in check_policy(adapt(Sees().eval(), short), reference()[0])[-1].text
    )
    wrong = replace(contract, frames=FrameStack(count=3, axis="channels"))
    assert findings(Sees().eval(), wrong)["input"].verdict == FAILURE


class Carrying(nn.Module):
    """A declared memory: half of what was steered before."""

    def initial_memory(self, batch):
        return torch.zeros(batch, 1)

    def forward(self, images, goals, memory):
        memory = 0.5 * memory + 0.5 * Seer()(images)[:, None]
        return memory[:, 0], memory


class Asked:
    """Another program, asked through a network; it counts pictures, and draws lots if it is told to."""

    training = False
    identity = "their driver 1.2"

    def __init__(self, noise=0.0):
        self.pictures, self.noise = 0, np.random.default_rng(0) if noise else None

    def __call__(self, images):
        self.pictures += len(images)
        return Seer()(images) + (0.0 if self.noise is None else float(self.noise.normal()))


UNSTEADY = [
    (lambda: Dropping(always=True).eval(), "the output is random"),
    (
        lambda: around(after=lambda y: y + torch.from_numpy(np.random.normal(size=len(y)))),  # noqa: NPY002
        "the output is random",
    ),
    (lambda: around(after=lambda y: y + random.random()), "the output is random"),
    (lambda: around(after=lambda y: 0 * y + torch.randn(len(y))), "the output is random"),
    (lambda: Remembering().eval(), "the output depends on the images before"),
    (lambda: around(lambda x: x - x.mean(0, keepdim=True)), "differently in a batch than alone"),
    (lambda: Asked(noise=1.0), "their driver 1.2 answers a picture otherwise"),
]


@pytest.mark.parametrize(("made", "sentence"), UNSTEADY)
def test_an_unsteady_policy_is_refused_before_it_is_attacked(made, sentence):
    with pytest.raises(
        PolicyContractError, match=r"^mine:it: expected a policy that answers a picture"
    ) as told:
        require_steady(adapt(made(), DECLARED), "mine:it")
    assert sentence in str(told.value)


@pytest.mark.parametrize("made", [made for made, _ in UNSTEADY[:6]])
def test_the_check_of_a_policy_says_the_same(made):
    with pytest.raises(PolicyContractError) as told:
        require_steady(adapt(made(), DECLARED), "mine")
    found = next(f for f in findings(made()).values() if f.verdict == FAILURE)
    assert found.text.partition("(")[0] in str(told.value)


def unimportant_bits(images):
    """Its last bits depend on the batch, as those of other kernels do."""
    return Seer()(images) * (1.0 + 1e-6 * len(images))


def test_a_steady_policy_passes_and_no_random_number_is_spent():
    def numbers():
        return float(torch.rand(())), float(np.random.random()), random.random()  # noqa: NPY002

    def seed():
        torch.manual_seed(1)
        np.random.seed(1)  # noqa: NPY002
        random.seed(1)

    seed()
    expected = numbers()
    stack = replace(DECLARED, frames=FrameStack(count=2))
    steady = [
        adapt(around(), DECLARED),
        adapt(Carrying().eval(), replace(DECLARED, stateless=False)),
        adapt(around(lambda x: 0.5 * x[:, :3] + 0.5 * x[:, 3:]), stack),
        adapt(unimportant_bits, DECLARED),
        # Nothing in it is random; a draw that nobody uses is still a draw.
        adapt(around(after=lambda y: y + 0 * torch.randn(len(y))), DECLARED),
    ]
    for policy in steady:
        seed()
        require_steady(policy, "mine")
        assert numbers() == expected
    assert steady[0](torch.ones(1, 3, 22, 40)) == adapt(around(), DECLARED)(torch.ones(1, 3, 22, 40))


def test_another_program_is_asked_three_pictures():
    program = Asked()
    require_steady(adapt(program, DECLARED), "mine")
    assert program.pictures == 3
