"""Policies that see several images or carry a state steer alike in an attack, in a driven world and in the live node."""

import numpy as np
import onnxruntime
import pytest
import torch
from onnx import TensorProto
from torch import nn

from advnerf_core.driving.rollout import Remembering
from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.exported_policy import export_program
from advnerf_core.policies.frames import FrameStack
from advnerf_core.policies.load import load_any_policy, load_driver
from advnerf_core.policies.onnx_policy import export_onnx
from tests.support.onnx_models import VIEW, declare_beside, network_model, save_beside

FLOAT = TensorProto.FLOAT
TICKS = 6
RNG = np.random.default_rng(0)
DRIVE = RNG.integers(0, 256, (TICKS, 8, 12, 3)).astype(np.uint8)


def weights_of(shape):
    return np.random.default_rng(1).normal(0.0, 0.05, shape).astype(np.float32)


def stacked(tick, stack, colours):
    """What the input should hold at a tick of `DRIVE`, written down by hand."""
    rows = []
    for back in range(stack.count):
        number = tick - back * stack.spacing
        black = np.zeros_like(DRIVE[0])
        frame = DRIVE[number] if number >= 0 else (DRIVE[0] if stack.first == "repeat" else black)
        rows.append(frame[..., ::-1] if colours == "BGR" else frame)
    return rows if stack.order == "newest_first" else rows[::-1]


STACKS = [
    (FrameStack(count=3), "NCHW", "RGB"),
    (FrameStack(count=3, spacing=2, first="black"), "NCHW", "BGR"),
    (FrameStack(count=2, order="newest_first"), "NHWC", "RGB"),
    (FrameStack(count=3, axis="time", order="newest_first"), "NCHW", "BGR"),
    (FrameStack(count=2, spacing=3, axis="time", first="black"), "NHWC", "BGR"),
]


@pytest.mark.parametrize(("stack", "layout", "colours"), STACKS)
def test_a_stack_of_images_is_what_onnx_runtime_is_given_by_hand(tmp_path, stack, layout, colours):
    contract = PolicyContract(VIEW, colours, 255.0, layout=layout, frames=stack)
    shape = contract.input_shape
    axes = list(range(1, 1 + len(shape)))
    nodes = [
        ("Mul", ["images", "weights"], ["weighted"], {}),
        ("ReduceMean", ["weighted"], ["mean"], {"axes": axes, "keepdims": 0}),
    ]
    weights = weights_of(shape)
    model = network_model(
        nodes, {"images": (FLOAT, ["B", *shape])}, {"mean": (FLOAT, ["B"])}, {"weights": weights[None]}
    )
    file = save_beside(model, tmp_path / "policy.onnx", contract.to_dict())
    session = onnxruntime.InferenceSession(file.read_bytes())
    expected = []
    for tick in range(TICKS):
        frames = np.stack(stacked(tick, stack, colours)).astype(np.float32)  # [N, H, W, 3]
        if layout == "NCHW":
            frames = np.moveaxis(frames, -1, 1)
            frames = frames if stack.axis == "time" else frames.reshape(shape)
        elif stack.axis == "channels":
            frames = np.concatenate(list(frames), axis=-1)
        expected.append(float(session.run(None, {"images": frames[None]})[0][0]))
    assert np.ptp(expected) > 1e-3
    driver = load_driver(file)
    for _ in range(2):
        assert [driver.steer(image, ()) for image in DRIVE] == pytest.approx(expected, abs=1e-5)
        driver.reset()
    loaded = load_any_policy(file).policy
    assert (loaded.stateless, loaded.differentiable) == (False, False)
    torch_weights = torch.from_numpy(weights)
    mine = adapt(lambda given: (given * torch_weights).mean(dim=axes), contract)
    images = torch.from_numpy(DRIVE).permute(0, 3, 1, 2) / 255.0
    for policy in (loaded, mine):
        for keep in (True, False):
            drive = Remembering(policy, 2, keep)
            found = [drive(torch.stack([image, image])) for image in images]
            assert torch.stack(found).mean(1).tolist() == pytest.approx(expected, abs=1e-5)
            assert len(drive.memories) == (TICKS + 1 if keep else 1)


def test_the_gradient_through_a_stack_reaches_all_images_that_it_holds():
    """The steering of the last tick against finite differences in every image of the drive, the first of which is repeated."""
    stack = FrameStack(count=3, spacing=2)
    weights = torch.from_numpy(weights_of((9, 8, 12))).double()
    policy = adapt(
        lambda given: torch.tanh((weights * given.sin()).sum((1, 2, 3))), PolicyContract(VIEW, frames=stack)
    )
    images = (torch.from_numpy(DRIVE[:4]).permute(0, 3, 1, 2) / 255.0).double().requires_grad_()

    def last(given):
        drive = Remembering(policy, 1)
        return torch.stack([drive(image[None]) for image in given]).sum()

    assert torch.autograd.gradcheck(last, images)


def leaky(path, shape, batch_axis, initial, batch="B"):
    """``h' = 0.5 h + mean(images) w``, ``steering = sum(h')``, with a state of the given shape without its batch, which may be fixed."""
    full = [*shape[:batch_axis], batch, *shape[batch_axis:]]
    axes = [axis for axis in range(len(full)) if axis != batch_axis]
    weight = np.arange(1, 1 + int(np.prod(shape)), dtype=np.float32).reshape(shape) * 0.01
    nodes = [
        ("ReduceMean", ["images"], ["grey"], {"axes": [1, 2, 3], "keepdims": 0}),
        ("Unsqueeze", ["grey", "axes"], ["column"], {}),
        ("Mul", ["column", "weight"], ["added"], {}),
        ("Mul", ["h_in", "half"], ["kept"], {}),
        ("Add", ["kept", "added"], ["h_out"], {}),
        ("ReduceSum", ["h_out", "axes"], ["steering"], {"keepdims": 0}),
    ]
    weights = {
        "axes": np.array(axes, np.int64),
        "weight": np.expand_dims(weight, batch_axis),
        "half": np.array(0.5, np.float32),
    }
    inputs = {"h_in": (FLOAT, full), "images": (FLOAT, ["B", 3, 8, 12])}
    outputs = {"h_out": (FLOAT, full), "steering": (FLOAT, [batch])}
    state = {"input": "h_in", "output": "h_out", "batch_axis": batch_axis, "initial": initial}
    return save_beside(network_model(nodes, inputs, outputs, weights), path, {"states": [state]})


@pytest.mark.parametrize(
    ("shape", "batch_axis", "initial", "batch"),
    [
        ((4,), 0, 0.0, "B"),
        ((2, 3), 1, 0.25, "B"),
        ((2, 3), 1, [float(number) for number in range(6)], 1),
    ],
)
def test_named_states_are_carried_as_by_hand(tmp_path, shape, batch_axis, initial, batch):
    file = leaky(tmp_path / "policy.onnx", shape, batch_axis, initial, batch)
    session = onnxruntime.InferenceSession(file.read_bytes())
    start = np.broadcast_to(
        np.float32(np.reshape(initial, shape) if isinstance(initial, list) else initial), shape
    )
    state, expected = np.expand_dims(start, batch_axis), []
    for image in DRIVE:
        given = np.moveaxis(image, -1, 0)[None].astype(np.float32) / 255.0
        steering, state = session.run(["steering", "h_out"], {"images": given, "h_in": state})
        expected.append(float(steering[0]))
    driver = load_driver(file)
    for _ in range(2):
        assert [driver.steer(image, ()) for image in DRIVE] == pytest.approx(expected, abs=1e-5)
        driver.reset()
    policy = load_any_policy(file).policy
    assert (
        "input",
        f"h_in {list(session.get_inputs()[0].shape)} float32: memory, h_out to h_in".replace("'", ""),
    ) in (policy.described_tensors())
    drive, images = Remembering(policy, 2), torch.from_numpy(DRIVE).permute(0, 3, 1, 2) / 255.0
    found = torch.stack([drive(torch.stack([image, 0.0 * image])) for image in images])
    assert found[:, 0].tolist() == pytest.approx(expected, abs=1e-5)
    assert found[-1, 1] == pytest.approx(float(start.sum()) * 0.5**TICKS, abs=1e-6), (
        "another car has its own memory"
    )


@pytest.mark.parametrize(
    ("state", "message"),
    [
        ({"input": "h"}, r"states.input: expected one of h_in .*got 'h'"),
        ({"output": "h"}, r"states.output: expected one of h_out .*got 'h'"),
        ({"batch_axis": 1}, r"fixed sizes but for the batch on axis 1, got h_in \[B, 4\]"),
        ({"initial": [1.0, 2.0]}, r"states.initial: expected one number or 4"),
        ({"name": "h"}, "name"),
    ],
)
def test_states_that_do_not_fit_are_refused(tmp_path, state, message):
    file = leaky(tmp_path / "policy.onnx", (4,), 0, 0.0)
    declare_beside(file, {"states": [{"input": "h_in", "output": "h_out", **state}]})
    with pytest.raises(PolicyContractError, match=message):
        load_any_policy(file)
    declare_beside(file, {"stateless": False})
    with pytest.raises(PolicyContractError, match="expected true, or states"):
        load_any_policy(file)


class Recurrent(nn.Module):
    """A network with a state and a stack of two images."""

    def initial_memory(self, batch):
        return torch.full((batch, 2, 3), 0.5)

    def forward(self, images, goals, memory):
        memory = 0.5 * memory + images.mean((2, 3)).reshape(-1, 2, 3)
        return memory.sum((1, 2)), memory


def test_a_network_may_have_a_memory_besides_its_stack():
    contract = PolicyContract(VIEW, stateless=False, frames=FrameStack(count=2, first="black"))
    policy = adapt(Recurrent().eval(), contract)
    drive, greys = Remembering(policy, 1), [0.2, 0.8, 0.4]
    found = [float(drive(torch.full((1, 3, 8, 12), grey))) for grey in greys]
    state, before, expected = np.full(6, 0.5), 0.0, []
    for grey in greys:
        state, before = 0.5 * state + np.repeat([before, grey], 3), grey
        expected.append(float(state.sum()))
    assert found == pytest.approx(expected, abs=1e-5)


def test_an_exported_program_carries_its_state_and_its_gradient(tmp_path):
    class Carried(nn.Module):
        def forward(self, images, state):
            state = 0.5 * state + images.mean((1, 2, 3))[:, None]
            return 0.1 * state[:, 0] ** 2, state

    batch = torch.export.Dim("batch", min=1, max=64)
    examples = (torch.rand(2, 3, 8, 12), torch.rand(2, 1))
    program = torch.export.export(Carried(), examples, dynamic_shapes=({0: batch}, {0: batch}))
    file = tmp_path / "policy.pt2"
    torch.export.save(program, file)
    (steers, carries), (_, takes) = program.graph_signature.user_outputs, program.graph_signature.user_inputs
    declare_beside(file, {"output_name": steers, "states": [{"input": takes, "output": carries}]})
    policy = load_any_policy(file).policy
    images = torch.rand(3, 1, 3, 8, 12, requires_grad=True)
    drive = Remembering(policy, 1)
    last = [drive(image) for image in images][-1]
    greys = images.detach().mean((1, 2, 3, 4))
    state = float(0.25 * greys[0] + 0.5 * greys[1] + greys[2])
    assert float(last.detach()) == pytest.approx(0.1 * state**2, abs=1e-6)
    (slopes,) = torch.autograd.grad(last.sum(), images)
    assert slopes.sum((1, 2, 3, 4)).tolist() == pytest.approx(
        [0.2 * state * each for each in (0.25, 0.5, 1.0)], abs=1e-5
    )


@pytest.mark.parametrize(
    "declared", [{"count": 1}, {"count": 3, "spacing": 0}, {"count": 2, "first": "white"}, {"number": 3}]
)
def test_a_wrong_stack_is_one_error(declared):
    for make in (
        lambda: PolicyContract.from_dict({"view": VIEW.to_dict(), "frames": declared}),
        lambda: PolicyContract(VIEW, frames=declared),
    ):
        with pytest.raises(PolicyContractError, match=next(reversed(declared))):
            make()


def test_a_section_may_be_given_as_its_keys_and_values():
    assert PolicyContract(VIEW, frames={"count": 3}) == PolicyContract(VIEW, frames=FrameStack(count=3))
    contract = PolicyContract(VIEW, states=[{"input": "h", "output": "g"}])
    assert (contract.states[0].initial, contract.stateless) == (0.0, False)
    assert PolicyContract.from_dict(contract.to_dict()) == contract


class Led(nn.Module):
    """A network of two outputs that is told a goal and remembers."""

    def initial_memory(self, batch):
        return torch.tensor([[0.5, -0.5]]).expand(batch, 2).clone()

    def forward(self, images, goals, memory):
        memory = 0.5 * memory + images.mean((2, 3))[:, :2] * (1.0 if goals is None else goals)
        return {"throttle": memory[:, 1], "angle": 0.3 * torch.tanh(memory.sum(1))}, memory


@pytest.mark.parametrize("goals", [None, torch.tensor([[0.5, 2.0], [1.0, -1.0]])])
def test_a_network_with_a_memory_is_exported_with_it(tmp_path, goals):
    contract = PolicyContract(VIEW, stateless=False, goal_size=0 if goals is None else 2, output_name="angle")
    policy, images = adapt(Led().eval(), contract), torch.from_numpy(DRIVE).permute(0, 3, 1, 2) / 255.0
    export_onnx(policy.network, contract, tmp_path / "led.onnx")
    export_program(policy.network, contract, tmp_path / "led.pt2")

    def driven(policy):
        drive = Remembering(policy, 2)
        return torch.stack([drive(torch.stack([image, image.flip(1)]), goals) for image in images]).tolist()

    expected = driven(policy)
    for name in ("led.onnx", "led.pt2"):
        assert np.allclose(driven(load_any_policy(tmp_path / name).policy), expected, atol=1e-5), name


def test_a_stack_is_exported_as_the_network_takes_it(tmp_path):
    stack = FrameStack(count=3, spacing=2, order="newest_first")
    weights = torch.from_numpy(weights_of((9, 8, 12)))
    policy = adapt(Weighted(weights), PolicyContract(VIEW, frames=stack))
    export_onnx(policy.network, policy.contract, tmp_path / "stack.onnx")
    driver, drive = load_driver(tmp_path / "stack.onnx"), Remembering(policy, 1)
    for image in DRIVE:
        expected = drive(torch.from_numpy(image).permute(2, 0, 1)[None] / 255.0)
        assert driver.steer(image, ()) == pytest.approx(float(expected), abs=1e-6)


class Weighted(nn.Module):
    def __init__(self, weights):
        super().__init__()
        self.weights = weights
        self.eval()

    def forward(self, images):
        return (images * self.weights).mean((1, 2, 3))
