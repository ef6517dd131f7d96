"""The choice of a device, and the check at start: ten rays and one gradient of each part, with devices that compute well, badly or not at all."""

import pytest
import torch
from torch.utils._python_dispatch import TorchDispatchMode

from advnerf_core.errors import DeviceError
from advnerf_core.fields.hash_grid import HashGrid, encode_reference
from advnerf_core.geometry import Pinhole
from advnerf_core.scene.agreement import (
    PARTS,
    SEARCH_PARTS,
    TEN_RAYS,
    compare,
    is_right,
    search_device,
    training_device,
)

HERE = torch.device("cpu")
NOTHING = torch.device("meta")  # has shapes, and no values
without_gpu = pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")


class Imprecise(TorchDispatchMode):
    """A device whose products are a hundredth too large."""

    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        out = func(*args, **(kwargs or {}))
        wrong = func in (torch.ops.aten.mul.Tensor, torch.ops.aten.addmm.default)
        return out * 1.01 if wrong and out.is_floating_point() else out


@pytest.mark.parametrize("part", PARTS)
def test_plain_torch_gives_the_numbers_of_the_kernels(part):
    assert TEN_RAYS.width * TEN_RAYS.height == 10
    for lens in (TEN_RAYS, Pinhole(24, 10, 20.0, 20.0, 12.0, 5.0)):
        found = compare(part, HERE, lens)
        assert found.agrees, found
        # In single precision far below the tolerance, which leaves room for a device's own functions.
        assert found.difference < 0.1 * found.tolerance
        assert found.seconds > 0.0
        assert found.processor_seconds > 0.0


# On one processor a policy is the same library on both sides.
@pytest.mark.parametrize("part", [part for part in PARTS if part != "policy"])
def test_a_device_that_computes_badly_is_noticed_in_every_part(part):
    with Imprecise():
        found = compare(part, HERE)
    assert not found.trouble
    assert not found.agrees
    assert found.difference > 2.0 * found.tolerance


@pytest.mark.parametrize(
    ("device", "trouble"),
    [
        (NOTHING, "not computing with meta: hash encoding failed, "),
        (HERE, "hash encoding differ from the processor's by "),
    ],
    ids=["without values", "imprecise"],
)
def test_a_device_that_is_wrong_is_refused_in_two_lines(device, trouble, capsys):
    with Imprecise():
        assert not is_right(device)
    refused, instead = capsys.readouterr().err.splitlines()
    assert trouble in refused
    assert refused.endswith(", at most 1e-05 is expected") == (device == HERE)
    assert instead.startswith("advnerf: computing with the processor")


def test_a_device_that_is_right_is_used_without_a_word(capsys):
    assert is_right(HERE)
    assert capsys.readouterr().err == ""


@without_gpu
def test_without_a_gpu_searches_say_so_and_trainings_use_the_processor(capsys):
    with pytest.raises(DeviceError, match="expected an NVIDIA GPU that torch can use"):
        search_device()
    assert training_device() == torch.device("cpu")
    assert capsys.readouterr().err == ""


@pytest.mark.gpu
@pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a CUDA device")
def test_a_gpu_agrees_in_plain_torch_and_the_answer_is_kept():
    there = torch.device("cuda")
    for part in PARTS:
        assert compare(part, there, Pinhole(200, 66, 160.0, 160.0, 100.0, 33.0)).agrees, part
    assert search_device() is search_device() is not None
    assert training_device().type == "cuda"


def test_the_check_leaves_the_random_numbers_of_the_process_alone():
    before = torch.get_rng_state()
    for part in SEARCH_PARTS:
        compare(part, HERE)
    assert torch.equal(torch.get_rng_state(), before)


def test_the_encoding_has_its_shape_on_a_device_without_values():
    grid = HashGrid()
    features = encode_reference(torch.empty(7, 3, device="meta"), grid.table.to("meta"), grid.levels)
    assert features.shape == (7, grid.config.width)
