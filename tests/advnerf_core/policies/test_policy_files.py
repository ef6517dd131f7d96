"""Policy files of strangers: weights in other files, several inputs and outputs, whole numbers as pixels."""

import os
import shutil
from pathlib import Path

import numpy as np
import onnx
import pytest
import torch
import yaml
from onnx import TensorProto
from torch import nn

from advnerf_core.policies.adapter import adapt
from advnerf_core.policies.contract import PolicyContract, PolicyContractError
from advnerf_core.policies.load import load_any_policy, load_driver
from advnerf_core.policies.onnx_policy import OnnxNetwork
from advnerf_core.policies.tensors import TensorInfo, chosen_tensors
from tests.support.onnx_models import (
    IMAGE,
    VIEW,
    declare_beside,
    mean_model,
    network_model,
    save_beside,
    steering,
    steering_of,
)

CASES = Path(__file__).parents[4] / "shared" / "data" / "cases"


@pytest.fixture
def external(tmp_path):
    return save_beside(mean_model({"steering": 0.25}), tmp_path / "a" / "policy.onnx", weights="policy.data")


def test_weights_in_another_file_are_used_from_any_folder(external, tmp_path, monkeypatch):
    other = save_beside(mean_model({"steering": -0.5}), tmp_path / "b" / "policy.onnx", weights="policy.data")
    for folder in (tmp_path, external.parent, other.parent):
        monkeypatch.chdir(folder)
        assert steering(OnnxNetwork(external), 0.5) == pytest.approx([0.125] * 2)
        assert steering(OnnxNetwork(other), 0.5) == pytest.approx([-0.25] * 2)
    assert OnnxNetwork(external).sha256 != OnnxNetwork(other).sha256


def test_the_hash_covers_the_weights(external, tmp_path):
    before = OnnxNetwork(external).sha256
    (external.parent / "notes.txt").write_text("unrelated")
    moved = shutil.copytree(external.parent, tmp_path / "moved") / "policy.onnx"
    assert OnnxNetwork(moved).sha256 == before
    weights = external.parent / "policy.data"
    weights.write_bytes(weights.read_bytes().replace(np.float32(0.25).tobytes(), np.float32(0.75).tobytes()))
    network = OnnxNetwork(external)
    assert steering(network, 0.5) == pytest.approx([0.375] * 2)
    assert network.sha256 != before


def test_a_model_that_is_loaded_does_not_look_at_its_files_again(external):
    network = OnnxNetwork(external)
    (external.parent / "policy.data").write_bytes(b"\xff" * 4)
    external.unlink()
    assert steering(network, 0.5) == pytest.approx([0.125] * 2)


def test_a_link_to_a_model_uses_the_weights_beside_the_model(external, tmp_path):
    save_beside(mean_model({"steering": 9.0}), tmp_path / "policy.onnx", weights="policy.data").unlink()
    (tmp_path / "policy.onnx").symlink_to(external)  # beside other weights of the same name
    assert steering(OnnxNetwork(tmp_path / "policy.onnx"), 0.5) == pytest.approx([0.125] * 2)


@pytest.mark.parametrize("kind", ["missing", "link", "linked folder", "pipe", "above", "absolute"])
def test_weights_elsewhere_are_refused_in_one_line(tmp_path, kind):
    name = {"above": "../w.data", "absolute": str(tmp_path / "w.data"), "linked folder": "in/w.data"}.get(
        kind, "w.data"
    )
    folder = tmp_path / "model"
    model = mean_model({"steering": 0.25})
    file = save_beside(model, folder / "policy.onnx", weights="w.data")
    (folder / "w.data").rename(tmp_path / "w.data")
    for tensor in model.graph.initializer:
        for entry in tensor.external_data:
            entry.value = name if entry.key == "location" else entry.value
    file.write_bytes(model.SerializeToString())
    if kind == "link":
        (folder / "w.data").symlink_to(tmp_path / "w.data")
    if kind == "linked folder":
        (folder / "in").symlink_to(tmp_path)
    if kind == "pipe":
        os.mkfifo(folder / "w.data")
    expected = "its own folder" if kind in ("above", "absolute") else "copy that file there"
    with pytest.raises(PolicyContractError, match=expected) as caught:
        OnnxNetwork(file)
    assert name in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_file_of_its_own_keeps_its_hash(tmp_path):
    """Hashes of published policies are those of file and declaration, as `sha256sum` would give them."""
    import hashlib

    file = save_beside(mean_model({"steering": 0.25}), tmp_path / "policy.onnx")
    declared = PolicyContract(VIEW, differentiable=False).to_json()
    assert "output_name" not in declared
    expected = hashlib.sha256(file.read_bytes() + declared.encode()).hexdigest()
    assert OnnxNetwork(file).sha256 == expected


def test_several_outputs_are_asked_for(tmp_path):
    model = mean_model({"throttle": 0.7, "angle": -0.2})
    file = save_beside(model, tmp_path / "policy.onnx")
    with pytest.raises(PolicyContractError, match=r"throttle \[B, 1\] float32, angle .*declare output_name"):
        load_driver(file)
    for name, gain in (("angle", -0.2), ("throttle", 0.7)):
        save_beside(model, file, {"output_name": name})
        assert steering(OnnxNetwork(file), 0.5) == pytest.approx([0.5 * gain] * 2)
    save_beside(model, file, {"output_name": "steer"})
    with pytest.raises(PolicyContractError, match=r"output_name: expected one of throttle .*got 'steer'"):
        OnnxNetwork(file)


def test_the_column_that_steers_is_asked_for(tmp_path):
    model = mean_model([0.7, -0.2], columns=True)
    file = save_beside(model, tmp_path / "policy.onnx")
    with pytest.raises(PolicyContractError, match=r"has 2 columns; declare output_column.*0 to 1"):
        OnnxNetwork(file)
    save_beside(model, file, {"output_column": 1})
    assert steering(OnnxNetwork(file), 0.5, count=3) == pytest.approx([-0.1] * 3)
    policy = load_any_policy(file).policy
    torch.testing.assert_close(policy(torch.full((3, 3, 8, 12), 0.5)), torch.full((3,), -0.1))
    assert ("output", "steering [B, 2] float32: steering, column 1") in policy.described_tensors()
    for wrong, message in ((2, "expected 0 to 1"), (-1, "whole number >= 0"), (True, "whole number")):
        save_beside(model, file, {"output_column": wrong})
        with pytest.raises(PolicyContractError, match=message):
            OnnxNetwork(file)


def test_whole_numbers_are_0_to_255_by_their_type(tmp_path):
    model = mean_model({"steering": 0.001}, TensorProto.UINT8)
    file = save_beside(model, tmp_path / "policy.onnx")
    assert steering(OnnxNetwork(file), 100 / 255) == pytest.approx(
        [0.1] * 2
    )  # not the 0 or 0.001 of a rounded 0..1
    driver, image = load_driver(file), np.full((8, 12, 3), 200, np.uint8)
    assert driver.steer(image, ()) == pytest.approx(0.2)
    for declared in ({"value_max": 255}, {"colour_space": "BGR"}):
        save_beside(model, file, declared)
        assert steering(OnnxNetwork(file), 100 / 255) == pytest.approx([0.1] * 2)
    for declared in ({"value_max": 1}, {"mean": 127.5}, {"std": [2.0, 2.0, 2.0]}):
        save_beside(model, file, declared)
        with pytest.raises(
            PolicyContractError, match="expected value_max 255, mean 0 and std 1 for the uint8"
        ):
            OnnxNetwork(file)


def test_other_whole_numbers_are_refused_before_the_first_image(tmp_path):
    file = save_beside(mean_model({"steering": 1.0}, TensorProto.INT32), tmp_path / "policy.onnx")
    with pytest.raises(
        PolicyContractError, match=r"expected images of .*uint8, got images \[B, 3, 8, 12\] int32"
    ):
        OnnxNetwork(file)


IMAGES, GOALS = TensorInfo("x", IMAGE, "float32"), TensorInfo("y", ("B", 2), "float32")
STEERING = TensorInfo("s", ("B", 1), "float32")


@pytest.mark.parametrize("order", [(IMAGES, GOALS), (GOALS, IMAGES)])
def test_images_and_goals_are_told_apart_by_their_shapes(order):
    found = chosen_tensors(order, [STEERING], PolicyContract(VIEW, goal_size=2), Path("p"))
    assert (found.image, found.goal) == (IMAGES, GOALS)


def test_inputs_with_more_than_one_reading_are_asked_for():
    unknown = [TensorInfo("a", None, "float32"), TensorInfo("b", None, "float32")]
    with pytest.raises(PolicyContractError, match="declare input_name: the one that takes the images"):
        chosen_tensors(unknown, [STEERING], PolicyContract(VIEW, goal_size=2), Path("p"))
    contract = PolicyContract(VIEW, goal_size=2, input_name="b")
    found = chosen_tensors(unknown, [STEERING], contract, Path("p"))
    assert (found.image.name, found.goal.name) == ("b", "a")


@pytest.mark.parametrize(
    ("inputs", "declared", "message"),
    [
        ([IMAGES, GOALS], {}, r"expected 1 input \(images\) in p, got x .*, y "),
        ([IMAGES], {"goal_size": 2}, "expected 2 inputs"),
        ([IMAGES], {"input_name": "z"}, "input_name: expected one of x .*got 'z'"),
        ([IMAGES], {"layout": "NHWC"}, r"expected an input of \[B, 8, 12, 3\] \(NHWC, RGB\), got x"),
        ([IMAGES], {"colour_space": "GRAY"}, r"expected an input of \[B, 1, 8, 12\]"),
        ([TensorInfo("x", ("B", 288), "float32")], {}, r"expected an input of \[B, 3, 8, 12\]"),
    ],
)
def test_inputs_that_do_not_fit_are_refused_when_the_file_is_loaded(inputs, declared, message):
    with pytest.raises(PolicyContractError, match=message):
        chosen_tensors(inputs, [STEERING], PolicyContract(VIEW, **declared), Path("p"))


class TwoHeads(nn.Module):
    def forward(self, images):
        mean = images.float().mean((1, 2, 3))[:, None]
        return {"throttle": 0.7 * mean, "both": mean * torch.tensor([0.5, -0.25])}


def save_program(file, declared, example):
    batch = torch.export.Dim("batch", min=1, max=64)
    program = torch.export.export(TwoHeads(), (example,), dynamic_shapes=({0: batch},))
    torch.export.save(program, file)
    file.with_name(file.name + ".policy.yaml").write_text(
        yaml.safe_dump({"view": VIEW.to_dict(), **declared})
    )
    return list(program.graph_signature.user_outputs)


def test_an_exported_program_is_asked_the_same_questions(tmp_path):
    file = tmp_path / "policy.pt2"
    names = save_program(file, {}, torch.rand(2, 3, 8, 12))
    with pytest.raises(PolicyContractError, match="declare output_name"):
        load_any_policy(file)
    save_program(file, {"output_name": names[1]}, torch.rand(2, 3, 8, 12))
    with pytest.raises(PolicyContractError, match="declare output_column"):
        load_any_policy(file)
    save_program(file, {"output_name": names[1], "output_column": 1}, torch.rand(2, 3, 8, 12))
    grey = torch.full((3, 3, 8, 12), 0.5, requires_grad=True)
    found = load_any_policy(file).policy(grey)
    torch.testing.assert_close(found, torch.full((3,), -0.125))
    found.sum().backward()
    torch.testing.assert_close(grey.grad, torch.full_like(grey, -0.25 / (3 * 8 * 12)))
    save_program(
        file, {"output_name": names[0], "output_unit": "deg"}, torch.zeros(2, 3, 8, 12, dtype=torch.uint8)
    )
    policy = load_any_policy(file).policy
    assert not policy.differentiable
    expected = np.deg2rad(0.7 * 51.0)
    torch.testing.assert_close(policy(torch.full((2, 3, 8, 12), 0.2)), torch.full((2,), float(expected)))


class Squeezed(torch.nn.Module):
    def forward(self, images):
        return (0.7 * images.mean((1, 2, 3), keepdim=True)).squeeze()


def test_a_file_for_one_image_may_squeeze_its_answer_to_a_number(tmp_path):
    """As many export it: the number can only be that image's."""
    mean = ("ReduceMean", ["images"], ["steering"], {"axes": [0, 1, 2, 3], "keepdims": 0})
    model = network_model(
        [mean], {"images": (TensorProto.FLOAT, [1, 3, 8, 12])}, {"steering": (TensorProto.FLOAT, [])}
    )
    network = OnnxNetwork(save_beside(model, tmp_path / "policy.onnx"))
    assert steering(network, 0.5, 1) == pytest.approx([0.5])
    assert steering(network, 0.5, 3) == pytest.approx([0.5] * 3)
    program = torch.export.export(Squeezed(), (torch.rand(1, 3, 8, 12),))
    torch.export.save(program, tmp_path / "policy.pt2")
    policy = load_any_policy(declare_beside(tmp_path / "policy.pt2", {})).policy
    for count in (1, 4):
        grey = torch.full((count, 3, 8, 12), 0.5, requires_grad=True)
        found = policy(grey)
        torch.testing.assert_close(found, torch.full((count,), 0.35))
        found.sum().backward()
        torch.testing.assert_close(grey.grad, torch.full_like(grey, 0.7 / (3 * 8 * 12)))


def test_a_file_for_four_images_is_refused_when_it_is_loaded(tmp_path):
    """It had worked for an attack from four starts, and failed from any other number."""
    mean = ("ReduceMean", ["images"], ["steering"], {"axes": [1, 2, 3], "keepdims": 0})
    model = network_model(
        [mean], {"images": (TensorProto.FLOAT, [4, 3, 8, 12])}, {"steering": (TensorProto.FLOAT, [4])}
    )
    with pytest.raises(PolicyContractError, match=r"it takes 4 at a time; export it with a dynamic batch"):
        OnnxNetwork(save_beside(model, tmp_path / "policy.onnx"))


def test_a_network_may_normalise_its_input_in_place():
    images = torch.full((2, 3, 8, 12), 0.75, requires_grad=True)
    policy = adapt(lambda x: x.sub_(0.5).div_(0.5).mean((1, 2, 3)), PolicyContract(VIEW))
    found = policy(images)
    torch.testing.assert_close(found, torch.full((2,), 0.5))
    assert (images == 0.75).all()
    found.sum().backward()
    torch.testing.assert_close(images.grad, torch.full_like(images, 2.0 / (3 * 8 * 12)))


def test_a_network_of_several_outputs_is_asked_for_the_one_that_steers():
    grey = torch.full((2, 3, 8, 12), 0.5)
    steers = torch.full((2,), 0.35)
    torch.testing.assert_close(adapt(TwoHeads(), PolicyContract(VIEW, output_name="throttle"))(grey), steers)
    both = adapt(lambda images: tuple(TwoHeads()(images).values()), PolicyContract(VIEW, output_index=0))
    torch.testing.assert_close(both(grey), steers)
    for network, how in (
        (TwoHeads(), r"declare output_name, one of \['throttle', 'both'\]"),
        (both.network, r"output_index, one of \[0, 1\]"),
    ):
        with pytest.raises(PolicyContractError, match=how):
            adapt(network, PolicyContract(VIEW))(grey)


def test_one_output_in_a_tuple_is_that_output_and_numbers_are_none():
    grey = torch.full((1, 3, 8, 12), 0.5)
    alone = adapt(lambda images: (images.mean(dim=(1, 2, 3)),), PolicyContract(VIEW))
    torch.testing.assert_close(alone(grey), torch.full((1,), 0.5))
    with pytest.raises(PolicyContractError, match=r"an array of steering \[B\] .*, got a list of numbers"):
        adapt(lambda images: [0.5], PolicyContract(VIEW))(grey)


def test_names_of_inputs_are_refused_where_there_is_no_file():
    with pytest.raises(PolicyContractError, match=r"for an \.onnx or \.pt2 file only"):
        adapt(TwoHeads(), PolicyContract(VIEW, input_name="images"))


@pytest.mark.skipif(not CASES.is_dir(), reason="needs the shared cases")
def test_the_files_of_strangers(tmp_path, monkeypatch):
    monkeypatch.chdir(CASES / "onnx_external" / "B")
    for name, truth in (("A", 0.01288), ("B", -0.00237)):
        network = OnnxNetwork(Path("..") / name / "model.onnx")
        grey = np.full((1, 3, 66, 200), 0.5, np.float32)
        assert float(steering_of(network, grey)[0]) == pytest.approx(truth, abs=6e-6)
    two = CASES / "onnx_two_outputs" / "two_ta.onnx"
    with pytest.raises(PolicyContractError, match="declare output_name"):
        OnnxNetwork(two)
    mine = Path(shutil.copy(two, tmp_path / "two_ta.onnx"))
    declared = yaml.safe_load((two.parent / "two_ta.onnx.policy.yaml").read_text())
    angle = onnx.load(two).graph.output[1].name
    mine.with_name("two_ta.onnx.policy.yaml").write_text(yaml.safe_dump({**declared, "output_name": angle}))
    steering_rad = steering_of(
        OnnxNetwork(mine), np.random.default_rng(0).random((2, 3, 66, 200), np.float32)
    )
    assert not np.allclose(steering_rad, 0.7, atol=0.1)
