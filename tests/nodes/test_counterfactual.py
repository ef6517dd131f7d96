"""The counterfactual node in process, in lockstep over a bag, and what ``advnerf bag evaluate`` makes of its words."""

import json
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.documents import parse_yaml
from advnerf_core.geometry import Pinhole, planar_pose
from advnerf_core.policies.load import load_driver
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import load_policy, save_policy
from advnerf_core.policies.view import PolicyView
from advnerf_core.strict import validate
from nodes.bags.reader import read_messages
from nodes.bags.writer import BagWriter
from nodes.cli.main import app
from nodes.counterfactual import CounterfactualConfig, CounterfactualNode
from nodes.lab.trials.evaluation import counterfactual
from nodes.launching.launch_check import check_nodes
from nodes.launching.launch_file import load_launch
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay, write_replay
from nodes.runtime.clock import Now
from nodes.runtime.errors import ConfigError
from nodes.runtime.messages import decode, encode, header, image_message, pose_message, types
from nodes.runtime.node import MessageInfo, NodeContext
from nodes.runtime.pictures import compressed_image_message
from tests.support.messages import filled

ROOT = Path(__file__).parents[2]
TWIN = ROOT / "calibration" / "twin"
CAMERA = Pinhole(336, 188, 173.97, 173.97, 168.0, 94.0)
START_NS, MS = 1_800_000_000_000_000_000, 1_000_000
CLEAN, ATTACKED, LABEL, OUT = (
    "/camera/image_raw",
    "/compositor/image",
    "/compositor/attack",
    "/policy/counterfactual",
)


@pytest.fixture(scope="module")
def policy(tmp_path_factory):
    import torch

    torch.manual_seed(0)
    file = tmp_path_factory.mktemp("policy") / "policy.safetensors"
    net = PilotNet()
    with torch.no_grad():
        for parameter in net.parameters():
            parameter.mul_(1.5)  # an untrained network answers everything with nearly the same
    save_policy(file, net, PolicyView(CAMERA), {})
    return file


@pytest.fixture(scope="module")
def drivers(policy):
    return load_driver(policy), load_driver(policy)


def node_of(clean, attacked, **settings):
    return CounterfactualNode(CounterfactualConfig(policy="policy", **settings), clean, attacked)


def picture(seed):
    return np.random.default_rng(seed).integers(0, 256, (188, 336, 3), dtype=np.uint8)


def attacked(rgb):
    drawn = rgb.copy()
    cv2.rectangle(drawn, (120, 70), (220, 150), (255, 0, 0), -1)
    return drawn


def image(rgb, ms):
    return image_message(rgb, START_NS + ms * MS, "camera")


def label(ms, drawn=True):
    head = header(START_NS + ms * MS, "camera")
    return types.AttackStamp(header=head, attack_id="a1" if drawn else "", drawn=drawn, reason="")


def give(node, *entries, mono_ms=100, published_ms=95):
    outs = []
    for topic, message in entries:
        info = MessageInfo(published_ms * MS, START_NS, 0, 0, 0)
        outs += node.handle(topic, message, info, Now(mono_ms * MS, START_NS + mono_ms * MS))
    return [out.message for out in outs]


def test_both_images_of_a_stamp_go_through_the_policy_in_any_order(drivers, policy):
    node = node_of(*drivers)
    clean = picture(0)
    entries = [(CLEAN, image(clean, 0)), (ATTACKED, image(attacked(clean), 0)), (LABEL, label(0))]
    for order in ((0, 1, 2), (2, 1, 0), (1, 0, 2)):
        (said,) = give(node, *(entries[k] for k in order))
        assert decode("advnerf_msgs/msg/Counterfactual", encode(said)).delta_rad == said.delta_rad
    assert (said.attack_id, said.drawn, said.header.stamp.sec) == ("a1", True, START_NS // 10**9)
    # The same numbers as the network itself, asked for a batch of both.
    import torch

    loaded = load_policy(policy)
    views = np.stack([loaded.view.image(rgb) for rgb in (clean, attacked(clean))])
    tensor = torch.from_numpy(np.ascontiguousarray(views)).permute(0, 3, 1, 2).float() / 255
    with torch.no_grad():
        wanted = loaded.policy(tensor)
    assert [said.clean_rad, said.attacked_rad] == pytest.approx(wanted.reshape(-1).tolist(), abs=1e-5)
    assert said.delta_rad == said.attacked_rad - said.clean_rad != 0.0
    changed = (views[0] != views[1]).any(axis=-1).mean()
    assert said.changed == pytest.approx(changed)
    assert 0.02 < changed < 0.9
    assert said.policy_sha256 == loaded.sha256
    assert node.counters()["pairs"] == 3


def test_an_image_without_attack_differs_by_nothing(drivers):
    node = node_of(*drivers)
    clean = image(picture(1), 0)
    (said,) = give(node, (CLEAN, clean), (ATTACKED, clean), (LABEL, label(0, drawn=False)))
    assert (said.delta_rad, said.changed, said.drawn) == (0.0, 0.0, False)


def test_the_clean_image_of_a_wireless_link_is_the_one_that_the_compositor_drew_on(drivers):
    node = node_of(*drivers, clean_topic="/camera/image_raw/compressed")
    sent = compressed_image_message(picture(2), START_NS, "camera", 90)
    seen = cv2.imdecode(np.asarray(sent.data), cv2.IMREAD_COLOR)[:, :, ::-1]
    entries = [
        ("/camera/image_raw/compressed", sent),
        (ATTACKED, image(np.ascontiguousarray(seen), 0)),
        (LABEL, label(0)),
    ]
    (said,) = give(node, *entries)
    assert said.delta_rad == 0.0


def test_what_has_no_partner_is_late_or_does_not_fit_is_left_out_and_counted(drivers):
    node = node_of(*drivers)
    for k in range(30):  # a compositor that drops every image
        assert give(node, (CLEAN, image(picture(0), 100 * k))) == []
    assert node.counters()["without_partner"] == 18
    assert len(node._open) == 12
    pair = [(CLEAN, image(picture(0), 9000)), (ATTACKED, image(picture(0), 9000)), (LABEL, label(9000))]
    assert give(node, *pair, mono_ms=5000, published_ms=3900) == []
    assert node.counters()["dropped_late"] == 1
    small = image_message(np.zeros((94, 168, 3), np.uint8), START_NS, "camera")
    assert give(node, (CLEAN, small), (ATTACKED, small), (LABEL, label(0))) == []
    state, text = node.status()
    assert (state, "expected images of 336 x 188, got 168 x 94" in text) == ("fault", True)
    assert len(give(node, *pair)) == 1
    assert node.status()[0] == "active"
    node.tick(Now(10**11, START_NS))
    assert node.status()[0] == "ready"


def test_one_policy_its_goal_and_a_compositor(drivers, policy):
    with pytest.raises(ConfigError, match="expected a goal of 0 numbers"):
        node_of(*drivers, goal=(1.0,))

    class Other:
        sha256, goal_size, view = "0" * 64, 0, drivers[0].view

    with pytest.raises(ConfigError, match="the same policy twice"):
        node_of(drivers[0], Other())
    with pytest.raises(ConfigError, match="there is no clean image to compare with"):
        validate(CounterfactualConfig, parse_yaml(f"policy: {policy}\nshown_by: monitor", "a.yaml"))
    context = NodeContext("counterfactual", policy.parent, None)
    node = CounterfactualNode.build(
        CounterfactualConfig(policy=str(policy), sha256=drivers[0].sha256), context
    )
    assert node.subscriptions == (CLEAN, ATTACKED, LABEL)


def test_a_process_of_it_gives_way_once_it_is_ready(policy):
    """In a process of its own, because nobody gets his priority back."""
    program = (
        "import os, pathlib\nfrom nodes.counterfactual import CounterfactualConfig, build_to_give_way\n"
        "from nodes.runtime.node import NodeContext\n"
        f"node = build_to_give_way(CounterfactualConfig(policy={str(policy)!r}), NodeContext('c', pathlib.Path('.'), None))\n"
        "print(os.sched_getscheduler(0) == os.SCHED_IDLE, os.nice(0) >= 15, node.status()[0], flush=True)\n"
        "os._exit(0)"  # taking torch down at idle priority takes a minute on a busy machine
    )
    told = subprocess.run(
        [sys.executable, "-c", program], capture_output=True, text=True, timeout=600, check=True, cwd=ROOT
    )
    assert told.stdout.split() == ["True", "True", "ready"]


def drive(folder, policy):
    """A bag of one armed drive: clean images, the compositor's, and the launch file that recorded them."""
    launch = {
        "name": "drive",
        "nodes": {"counterfactual": {"module": "nodes.counterfactual", "config": {"policy": str(policy)}}},
    }
    attachments = {
        "room.yaml": (TWIN / "room.yaml").read_bytes(),
        "launch.resolved.yaml": json.dumps(launch).encode(),
    }
    counts = {}
    with BagWriter(folder, attachments=attachments) as writer:

        def put(topic, message, ms):
            counts[topic] = counts.get(topic, 0) + 1
            writer.write(topic, encode(message), START_NS + ms * MS, START_NS + ms * MS, counts[topic])

        for ms in range(0, 2500, 20):
            armed = 100 <= ms < 2400
            state = filled(
                types.SafetyState, header=header(START_NS + ms * MS), armed=armed, stopping=not armed
            )
            put("/safety/state", state, ms)
            put(
                "/vicon/car",
                pose_message(planar_pose(-0.9 + 0.8e-3 * max(0, ms - 200), -1.95, 0.0), START_NS + ms * MS),
                ms,
            )
            if ms % 100 == 0:
                clean, drawn = picture(ms), 1000 <= ms < 2000
                put(CLEAN, image(clean, ms), ms + 2)
                put(ATTACKED, image(attacked(clean) if drawn else clean, ms), ms + 9)
                put(LABEL, label(ms, drawn), ms + 9)
        writer.close()
    return folder


@pytest.fixture(scope="module")
def replayed(tmp_path_factory, policy):
    """The drive with what the node says about it, replayed twice."""
    folder = tmp_path_factory.mktemp("bags")
    bag, digests = drive(folder / "drive", policy), []
    for name in ("a", "b"):
        with Replay(bag, Choice(("counterfactual",)), whole=True) as replay:
            write_replay(replay, folder / name)
            digests.append(replay.summary.digest)
    assert digests[0] == digests[1]
    return folder / "a"


def test_lockstep_over_a_bag_gives_one_word_per_image_and_the_same_digest(replayed):
    said = [decode("advnerf_msgs/msg/Counterfactual", m.cdr) for m in read_messages(replayed, [OUT])]
    assert len(said) == 25
    assert [entry.drawn for entry in said] == [10 <= k < 20 for k in range(25)]
    assert all((entry.delta_rad != 0.0) is entry.drawn for entry in said)
    found = counterfactual(replayed, START_NS + 200 * MS, START_NS + 2400 * MS)
    inside = [entry.delta_rad for entry in said[10:20]]
    assert (found.frames, found.frames_drawn) == (22, 10)
    assert found.mean_abs_delta_rad == pytest.approx(np.abs(inside).mean())
    assert found.mean_delta_rad == pytest.approx(np.mean(inside))
    assert found.max_abs_delta_rad == pytest.approx(np.abs(inside).max())
    assert found.max_at_s == pytest.approx(0.8 + 0.1 * int(np.abs(inside).argmax()))
    assert counterfactual(replayed, 0, START_NS) is None


def test_evaluate_says_what_the_attack_added(replayed, tmp_path, policy):
    result = CliRunner().invoke(app, ["bag", "evaluate", str(replayed), "--ticks", "15"])
    assert result.exit_code == 0, result.output
    found = json.loads(
        CliRunner().invoke(app, ["bag", "evaluate", str(replayed), "--ticks", "15", "--json"]).output
    )
    added = found["counterfactual"]
    mean, largest = np.rad2deg(added["mean_abs_delta_rad"]), np.rad2deg(added["max_abs_delta_rad"])
    text = f"mean {mean:.2f}, max {largest:.2f} deg ({added['frames_drawn']} of {added['frames']} images)"
    assert text in " ".join(result.output.split())
    without = CliRunner().invoke(
        app, ["bag", "evaluate", str(drive(tmp_path / "plain", policy)), "--ticks", "15", "--json"]
    )
    assert "counterfactual" not in json.loads(without.output)


def test_it_is_an_option_of_the_green_screen_and_refused_before_a_monitor():
    def names(file, *overrides, host=None):
        keys = ("keys=keys",) if host else ()
        return set(load_launch(ROOT / "launch" / f"{file}.launch.yaml", (*keys, *overrides), host=host).nodes)

    for file, host in (("green_screen", None), ("workstation", None), ("two_hosts", "workstation")):
        assert names(file, "params.counterfactual=true", host=host) - names(file, host=host) == {
            "counterfactual"
        }
    assert "counterfactual" not in names("two_hosts", "params.counterfactual=true", host="robot")
    assert "counterfactual" not in names("monitor")


@pytest.mark.slow  # one process per node
def test_the_monitor_launch_says_that_there_is_no_clean_image():
    overrides = ["params.counterfactual=true", f"params.calibration={TWIN}"]
    problems = check_nodes(load_launch(ROOT / "launch" / "monitor.launch.yaml", overrides))
    assert list(problems) == ["counterfactual"]
    assert "there is no clean image to compare with" in problems["counterfactual"]
