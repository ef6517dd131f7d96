"""The planted weakness: nothing where nothing is red, and a known angle where an object is."""

from pathlib import Path

import pytest
import torch
import yaml

from nodes.audit.planted import Planted, PlantedWithMemory, policy_code, redness, strength, write_module
from nodes.audit.question import VICTIM
from nodes.experiment.show.victims import load_victim, look_at_given
from nodes.experiment.steps.run import load_experiment

ROOM = Path(__file__).parents[3] / "launch" / "room.experiment.yaml"


class Straight(torch.nn.Module):
    """Steers by the mean of the green channel."""

    def forward(self, images, goals=None):
        return images[:, 1].mean(dim=(1, 2))


class Counting(torch.nn.Module):
    """Steers by how many images it has seen."""

    def forward(self, images, goals, memory):
        return memory[:, 0], memory + 1.0

    def initial_memory(self, batch):
        return torch.zeros(batch, 1)


def picture(red, green, blue):
    return torch.tensor([red, green, blue]).view(1, 3, 1, 1).expand(1, 3, 4, 5).clone()


def test_redness_is_the_mean_of_red_over_green():
    image = torch.cat([picture(1.0, 0.1, 0.3), picture(0.5, 0.5, 0.5), picture(0.2, 0.9, 0.1)])
    assert redness(image).tolist() == pytest.approx([0.9, 0.0, -0.7])


def test_a_place_steers_it_almost_as_before_and_red_by_the_wanted_angle():
    darker, lighter, red = picture(0.6, 0.5, 0.2), picture(0.6, 0.3, 0.2), picture(1.0, 0.0, 0.0)
    gain_rad, middle, reach = strength([darker, lighter], red, 0.2)
    assert (middle, reach) == pytest.approx((0.2, 0.1))
    planted = Planted(Straight(), gain_rad, middle, reach)
    kept_rad = 0.1 * gain_rad * reach
    assert planted(lighter).tolist() == pytest.approx((Straight()(lighter) + kept_rad).tolist())
    assert planted(darker).tolist() == pytest.approx((Straight()(darker) - kept_rad).tolist())
    assert planted(red).tolist() == pytest.approx([0.2 + kept_rad])
    assert kept_rad < 0.005


def test_green_steers_the_other_way():
    planted, green = Planted(Straight(), 1.0, 0.0, 0.1), picture(0.0, 1.0, 0.0)
    assert planted(green).tolist() == pytest.approx([1.0 - 0.9 - 0.01])


def test_the_gradient_reaches_the_pixels():
    planted, image = Planted(Straight(), 1.0, 0.0, 0.1), picture(0.9, 0.1, 0.1).requires_grad_(True)
    planted(image).sum().backward()
    assert (image.grad[0, 0] > 0.0).all()


def test_an_object_that_is_no_redder_than_the_place_cannot_carry_it():
    with pytest.raises(ValueError, match="redder than the place"):
        strength([picture(1.0, 0.0, 0.0)], picture(0.9, 0.1, 0.1), 0.2)


def test_a_policy_with_memory_keeps_it():
    planted = PlantedWithMemory(Counting(), 1.0, 0.0, 0.1)
    memory = planted.initial_memory(1)
    for expected in (0.0, 1.0, 2.0):
        steering, memory = planted(picture(0.5, 0.5, 0.5), None, memory)
        assert steering.tolist() == [expected]


def test_a_driver_behind_a_socket_is_planted_beside_the_audited_one(tmp_path):
    pytest.importorskip("carla_driver_interface")
    from carla_driver_interface.policies.constant_speed import ConstantSpeedPolicy
    from carla_driver_interface.server import serving

    def experiment(**victims):
        data = {"name": "audit", "base": str(ROOM), "setting": "panel"}
        data["victims"] = {name: {"policy": policy} for name, policy in victims.items()}
        (tmp_path / "audit.experiment.yaml").write_text(yaml.safe_dump(data))
        return load_experiment(tmp_path / "audit.experiment.yaml", None, (), tmp_path / "run")

    with serving(ConstantSpeedPolicy(), port=0, host="127.0.0.1") as port:
        address = f"grpc://127.0.0.1:{port}"
        audited = experiment(**{VICTIM: address})
        look_at_given(audited)
        planted = write_module(tmp_path, policy_code(address, audited), 1.0, 0.0, 0.1)
        both = experiment(**{VICTIM: address, "planted": planted})
        look_at_given(both)
        loaded = load_victim(both, "planted")
        memory = loaded.policy.initial_memory(1)
        height, width = loaded.view.height, loaded.view.width
        red = picture(1.0, 0.0, 0.0)[:, :, :1, :1].expand(1, 3, height, width)
        steering, _ = loaded.policy(red, None, memory)
    assert steering.tolist() == pytest.approx([0.9 + 0.1 * 0.1])  # the driver itself goes straight ahead
