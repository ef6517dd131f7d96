"""The nodes of consecutive drives: started once, exchanged where a drive needs other ones, and started again when one has died."""

import os
import signal
from dataclasses import asdict
from pathlib import Path

import pytest

from hardware.mocap.vicon import free_udp_port
from nodes.bags.reader import read_attachment, read_info
from nodes.lab.trials.evaluation import attack_ids
from nodes.lab.trials.trial import SpoiledError, TrialPlan
from nodes.lab.trials.trial_runner import TrialNodes
from nodes.lab.trials.tries import drive_with_tries
from tests.support.faces import TWIN, red_attack

pytestmark = [pytest.mark.live, pytest.mark.slow]

ROOT = Path(__file__).parents[2]
NODES = ("twin", "camera", "vicon", "compositor", "policy", "safety", "motor")
STARTS = ((-1.1, -2.0, 0.0), (-0.6, -2.0, 0.0))


def test_nodes_are_started_once_for_drives_with_and_without_an_attack_and_again_when_one_died(tmp_path):
    made, attack = red_attack(tmp_path, "board")
    shared = [
        "policy.module=tests.support.live.straight_policy",
        f"params.calibration={TWIN}",
        f"params.vicon_port={free_udp_port()}",
    ]
    seen = []

    def drive(nodes, name, start, more=()):
        """Drive until it counts; which nodes ran is noted for the try that did."""
        plan = TrialPlan(start, 1.0, NODES)

        def once():
            outcome = asdict(nodes.drive([*shared, *more], plan, tmp_path / name))
            seen.append((nodes.starts, nodes.pids))
            return outcome

        return drive_with_tries(once, tmp_path / f"{name}.json", print)

    with TrialNodes(ROOT / "launch" / "green_screen.launch.yaml", tmp_path / "nodes", 90.0) as nodes:
        spoiled = [
            len(drive(nodes, *each)["spoiled"])
            for each in (
                ("plain", STARTS[0]),
                ("attacked", STARTS[1], [f"params.attack={attack}"]),
                ("plain_again", STARTS[0]),
            )
        ]
        (first, pids), *others = seen
        if not any(spoiled):  # a spoiled try rightly starts them again
            assert [starts for starts, _ in others] == [first, first]
            for _, later in others:
                assert {name for name in NODES if later[name] != pids[name]} == {"compositor"}
        assert "recorder" not in nodes.pids  # its bag is finished
        os.kill(nodes.pids["camera"], signal.SIGKILL)
        starts = nodes.starts
        drive(nodes, "after_death", STARTS[0])
        assert nodes.starts > starts
    assert nodes.pids == {}
    for name, ids in (
        ("plain", set()),
        ("attacked", {made.attack_id}),
        ("plain_again", set()),
        ("after_death", set()),
    ):
        bag = tmp_path / name / "bag"
        assert attack_ids(bag) == ids
        attached = attack.name in read_info(bag).attachments
        assert attached == bool(ids)
        assert str(bag).encode() in read_attachment(bag, "launch.resolved.yaml")


def test_a_graph_whose_drive_does_not_count_is_not_used_again(tmp_path, monkeypatch):
    monkeypatch.setattr("nodes.lab.trials.trial_runner.spoiled_by", lambda health: "late")
    shared = [
        "policy.module=tests.support.live.straight_policy",
        f"params.calibration={TWIN}",
        f"params.vicon_port={free_udp_port()}",
    ]
    with TrialNodes(ROOT / "launch" / "green_screen.launch.yaml", tmp_path / "nodes", 90.0) as nodes:
        with pytest.raises(SpoiledError, match="late"):
            nodes.drive(shared, TrialPlan(STARTS[0], 0.5, NODES), tmp_path / "one")
        assert nodes.pids == {}
