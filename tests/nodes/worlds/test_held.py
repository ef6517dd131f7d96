"""A world of a user's own is held to the contract at each call, and its errors name its file and line."""

import re

import numpy as np
import pytest

from advnerf_core.documents import parse_yaml
from hardware.worlds.world import NotOpenError
from nodes.lab.worlds.check import check_world
from nodes.lab.worlds.held import OwnWorldError
from nodes.lab.worlds.named import read_world
from tests.support.warehouse import EXAMPLES, small

SMALL = "kind: mine.py:Mine\nwidth: 112\nheight: 63\n"
BODY = """
import numpy as np
from dataclasses import replace
from hardware.worlds.world import NotOpenError
from world_warehouse import Warehouse

class Mine(Warehouse):
"""


def own(folder, members, kind=SMALL):
    (folder / "world_warehouse.py").write_text((EXAMPLES / "world_warehouse.py").read_text())
    (folder / "mine.py").write_text(BODY + members)
    return read_world(parse_yaml(kind, "mine.experiment.yaml"), folder)


def look(world):
    return world.observe_at(-5.0, 0.0, 0.0)


def photograph(world):
    return world.photograph(world.photo_poses(1, np.random.default_rng(0))[0])


WRONG = {
    "floats": (
        "    def photograph(self, T): return super().photograph(T) / 255.0\n",
        photograph,
        r"expected a picture \[\d+, \d+, 3\] uint8 from photograph; got float64 \[\d+, \d+, 3\]",
    ),
    "upright": (
        "    def observe_at(self, *pose, depth=True): return super().observe_at(*pose)[0].transpose(1, 0, 2), None\n",
        look,
        r"expected a picture \[63, 112, 3\] uint8 from observe_at; got uint8 \[112, 63, 3\]",
    ),
    "no depth is NaN": (
        "    def observe_at(self, *pose, depth=True):\n        rgb, z = super().observe_at(*pose)\n"
        "        return rgb, np.where(z > 2, np.nan, z).astype(np.float32)\n",
        look,
        r"expected depth above 0, infinite where nothing is hit, from observe_at; got values from \d\S* and \d+ NaN",
    ),
    "millimetres": (
        "    def observe_at(self, *pose, depth=True):\n        rgb, z = super().observe_at(*pose)\n        return rgb, (1e3 * z).astype(np.uint16)\n",
        look,
        r"expected depth \[63, 112\] float32 in metres; got uint16 \[63, 112\] from observe_at",
    ),
    "colours alone": (
        "    def observe(self, depth=True): return super().observe()[0]\n",
        lambda world: world.observe(),
        r"expected a pair of colours and depth from observe; got uint8 \[63, 112, 3\]",
    ),
    "no photographs": (
        "    def photo_poses(self, count, rng): return []\n",
        photograph,
        r"expected a list of poses .* from photo_poses, one for each photograph; got list with 0 poses",
    ),
    "flat poses": (
        "    def photo_poses(self, count, rng): return [p[:3] for p in super().photo_poses(count, rng)]\n",
        photograph,
        r"expected a list of poses \[4, 4\] .* at 0$",
    ),
    "lost car": (
        "    def step(self, *command): return replace(super().step(*command), x_m=float('nan'))\n",
        lambda world: (world.reset(-5.0, 0.0, 0.0), world.step(0.0, 1.0, 0.1)),
        r"expected a finite state of the car from step; got VehicleState\(x_m=nan",
    ),
    "no description": (
        "    def describe(self): pass\n",
        lambda world: world.describe(),
        r"expected a WorldDescription from describe; got NoneType",
    ),
    "nothing opened": (
        "    def __enter__(self): pass\n",
        lambda world: None,
        r"expected __enter__ to return the world; got NoneType; end it with return self",
    ),
    "neither yes nor no": (
        "    @property\n    def blocked(self): pass\n",
        lambda world: world.blocked,
        r"expected True or False from blocked; got NoneType",
    ),
    "a method in the place of a value": (
        "    def blocked(self): return False\n",
        lambda world: None,
        r"expected blocked to be a value or a property; got a method, which counts as true",
    ),
    "an exit": (
        "    def observe_at(self, *pose, depth=True): raise SystemExit(0)\n",
        look,
        r"observe_at has failed: SystemExit: 0 \(\S*mine\.py:8\)",
    ),
    "an error": (
        "    def observe_at(self, *pose, depth=True):\n        return {}['camera']\n",
        look,
        r"observe_at has failed: KeyError: 'camera' \(\S*mine\.py:9\)",
    ),
    "an error of a property": (
        "    @property\n    def state(self): return self.nothing\n",
        lambda world: world.state,
        r"state has failed: AttributeError: .*nothing.* \(\S*mine\.py:9\)",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_what_no_world_may_give_back_is_told_with_the_worlds_name(tmp_path, name):
    members, call, told = WRONG[name]
    with pytest.raises(OwnWorldError) as error, own(tmp_path, members).make() as world:
        call(world)
    assert re.search(rf"^world mine\.py:Mine: {told}", str(error.value)), str(error.value)


def test_an_error_of_its_making_or_opening_names_its_line(tmp_path):
    with pytest.raises(OwnWorldError, match=r"__init__ has failed: ValueError: no \(\S*mine\.py:8\)"):
        own(tmp_path, "    def __init__(self, config): raise ValueError('no')\n").make()
    named = own(tmp_path, "    def __enter__(self): raise ConnectionRefusedError('port 2000')\n", SMALL)
    with (
        pytest.raises(OwnWorldError, match=r"__enter__ has failed: ConnectionRefusedError: port 2000 \("),
        named.make(),
    ):
        pass


def test_the_check_of_a_world_reports_it_as_a_part_that_is_not_met(tmp_path):
    named = own(tmp_path, "    def observe_at(self, *pose, depth=True): return {}['camera']\n")
    last = check_world(named)[-1]
    assert last.state == "not met"
    assert re.search(r"observe_at has failed: KeyError: 'camera' \(\S*mine\.py:8\)", last.text)


def test_a_world_neither_moves_the_pose_that_it_is_given_nor_hides_errors(tmp_path):
    members = "    def photograph(self, T):\n        T[:3, 3] += 100.0\n        return super().photograph(T - 100.0)\n"
    members += "    def __exit__(self, *error): return True\n"
    with own(tmp_path, members).make() as world:
        (pose,) = world.photo_poses(1, np.random.default_rng(0))
        before = pose.copy()
        world.photograph(pose)
        assert (pose == before).all()
    assert not world.__exit__(KeyError, KeyError("mine"), None)


def test_our_own_errors_pass_and_a_good_world_is_unchanged(tmp_path):
    closed = own(tmp_path, "    def describe(self): raise NotOpenError('open it')\n").make()
    with pytest.raises(NotOpenError) as error:
        closed.describe()
    assert str(error.value) == "open it"
    named = own(tmp_path, "    pass\n")
    with named.make() as held, small().make() as plain:
        assert type(held).__name__ == "Mine"
        assert type(named.make()) is type(held)
        assert held.describe().to_dict() == plain.describe().to_dict()
        for one, other in zip(look(held), look(plain), strict=True):
            np.testing.assert_array_equal(one, other)
        assert held.reset(-5.0, 0.0, 0.0) == plain.reset(-5.0, 0.0, 0.0)
        assert held.step(0.1, 1.0, 0.1) == plain.step(0.1, 1.0, 0.1)
