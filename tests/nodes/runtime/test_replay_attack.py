"""Retro-attack, golden comparison, and the options of ``advnerf bag replay``."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
import yaml

from nodes.bags.info import BagMessage
from nodes.bags.reader import read_attachments, read_info, read_messages
from nodes.bags.writer import BagWriter
from nodes.cli import main as cli
from nodes.replaying.attack import plot_retro_attack, retro_attack
from nodes.replaying.golden import Golden, Tolerances, compare
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay, write_replay
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import decode, drive_message, encode, header, type_name, types
from nodes.runtime.topics import topic as topic_row
from tests.support.replays import CORNER, GOLDEN_FOLDER, GREEN, START_NS, pose, run


@pytest.fixture(autouse=True)
def _green_policy_is_found(monkeypatch):
    monkeypatch.syspath_prepend(str(GOLDEN_FOLDER))


@pytest.fixture(scope="module")
def clean_drive(tmp_path_factory):
    """The little bag as it would have been recorded without an attack, with what the policy said then."""
    folder = tmp_path_factory.mktemp("clean") / "drive"
    sys.path.insert(0, str(GOLDEN_FOLDER))
    try:
        with Replay(CORNER, clean(), whole=True) as replay:
            write_replay(replay, folder)
    finally:
        sys.path.remove(str(GOLDEN_FOLDER))
    return folder


def clean(*overrides):
    return Choice(GREEN.nodes, GREEN.replacements, None, ("compositor.attack=null", *overrides))


def test_retro_attack_is_the_difference_of_two_drives(clean_drive, tmp_path):
    attack = tmp_path / "new.attack.safetensors"
    attack.write_bytes(read_attachments(CORNER)["corner.attack.safetensors"])
    result = retro_attack(clean_drive, attack, GREEN)
    # Truth: the policy by hand on the images that were recorded and those with the face, made above in another way.
    green = {}
    for name, choice in (("attacked", GREEN), ("clean", clean())):
        images = [
            decode("sensor_msgs/msg/Image", m.cdr) for m in run(choice)[0] if m.topic == "/compositor/image"
        ]
        pixels = np.array([np.asarray(image.data).reshape(27, 48, 3)[..., 1] for image in images], float)
        green[name] = 0.01 * (pixels[:, :, 24:].sum((1, 2)) - pixels[:, :, :24].sum((1, 2))) / pixels[0].size
    np.testing.assert_allclose(result.clean_rad, green["clean"], atol=1e-7)
    np.testing.assert_allclose(result.attacked_rad, green["attacked"], atol=1e-7)
    np.testing.assert_array_equal(result.recorded_rad, result.clean_rad)
    delta = green["attacked"] - green["clean"]
    numbers = result.numbers()
    assert (numbers["frames"], numbers["frames_drawn"], numbers["clean_against_recorded_rad"]) == (
        12,
        12,
        0.0,
    )
    assert numbers["mean_abs_delta_rad"] == pytest.approx(np.abs(delta).mean(), abs=1e-7)
    assert numbers["largest_delta_rad"] == pytest.approx(delta[np.abs(delta).argmax()], abs=1e-7)
    side = "left" if delta.mean() > 0 else "right"
    assert f"{abs(np.rad2deg(delta.mean())):.2f} degrees more to the {side} on average" in result.verdict()
    result.write_json(tmp_path / "out" / "retro.json")
    saved = json.loads((tmp_path / "out" / "retro.json").read_text())
    assert saved["attack_id"] == result.attack_id
    assert [row["delta_rad"] for row in saved["images"]] == pytest.approx(delta, abs=1e-7)
    plot_retro_attack(result, tmp_path / "retro.png")
    assert (tmp_path / "retro.png").read_bytes()[:4] == b"\x89PNG"


def test_what_was_shown_in_the_recording_does_not_hide_the_attack(clean_drive, tmp_path):
    """A clean drive under "Attack off" on the page, and one of a car that was pushed, so never armed."""
    attack = tmp_path / "new.attack.safetensors"
    attack.write_bytes(read_attachments(CORNER)["corner.attack.safetensors"])
    expected = retro_attack(clean_drive, attack, GREEN)
    start_ns = read_info(clean_drive).start_ns
    with BagWriter(
        tmp_path / "off", read_attachments(clean_drive), read_info(clean_drive).metadata
    ) as writer:
        switch = types.AttackSwitch(header=header(start_ns), show=False, source="Ann")
        writer.write("/attack/switch", encode(switch), start_ns, start_ns, 0)
        for m in read_messages(clean_drive):
            writer.write(m.topic, m.cdr, m.log_ns, m.publish_ns, m.sequence)
    locked = Choice(GREEN.nodes, GREEN.replacements, None, ("compositor.interlock=true",))
    for bag, choice in ((tmp_path / "off", GREEN), (clean_drive, locked)):
        found = retro_attack(bag, attack, choice)
        assert found.drawn.all()
        np.testing.assert_array_equal(found.delta_rad, expected.delta_rad)


def test_retro_attack_on_the_command_line(clean_drive, tmp_path, capsys):
    attack = tmp_path / "new.attack.safetensors"
    attack.write_bytes(read_attachments(CORNER)["corner.attack.safetensors"])
    command = ["bag", "replay", str(clean_drive), "--attack", str(attack), "--replace", "policy=green_policy"]
    cli.app([*command, "--json", str(tmp_path / "r.json")], standalone_mode=False)
    printed = capsys.readouterr().out
    assert "with the face in view (12 of 12 images) the policy would have steered" in printed
    assert "clean against recorded: 0.000 degrees" in printed
    assert printed.count("in view") == 13


VEHICLE = Path(__file__).parents[3] / "calibration/twin/vehicle.yaml"
GREEN_TO_THE_LEFT = """
from advnerf_core import PolicyContract, PolicyView, adapt
from advnerf_core.geometry import Pinhole

def factory():
    view = PolicyView(Pinhole(48, 27, 24.0, 24.0, 24.0, 13.5), crop_top_px=0, crop_height_px=27, width=48, height=27)
    return adapt(lambda images: images[:, 1, :, 24:].mean((1, 2)) - images[:, 1, :, :24].mean((1, 2)), PolicyContract(view))
"""


@pytest.mark.parametrize("module", ["nodes.policy", "nodes.calibration_drive", "nodes.expert", "antigravity"])
def test_a_given_policy_drives_the_replay_of_any_recorded_node(
    clean_drive, tmp_path, capsys, monkeypatch, module
):
    (tmp_path / "green_to_the_left.py").write_text(GREEN_TO_THE_LEFT)
    monkeypatch.syspath_prepend(str(tmp_path))
    attack = tmp_path / "new.attack.safetensors"
    attack.write_bytes(read_attachments(CORNER)["corner.attack.safetensors"])
    bag = recorded_with(clean_drive, tmp_path / "bag", module)
    command = ["bag", "replay", str(bag), "--policy", "green_to_the_left:factory"]
    cli.app([*command, "--attack", str(attack), "--json", str(tmp_path / "r.json")], standalone_mode=False)
    numbers = json.loads((tmp_path / "r.json").read_text())
    assert numbers["frames_drawn"] == 12
    assert abs(numbers["mean_delta_drawn_rad"]) > 0.001
    cli.app([*command, "--nodes", "compositor,policy"], standalone_mode=False)
    assert "12 /policy/drive" in capsys.readouterr().out


def test_an_attack_on_a_node_that_looks_at_nothing_is_refused(clean_drive, tmp_path):
    attack = tmp_path / "new.attack.safetensors"
    attack.write_bytes(read_attachments(CORNER)["corner.attack.safetensors"])
    bag = recorded_with(clean_drive, tmp_path / "bag", "nodes.calibration_drive")
    with pytest.raises(BagError, match=r"a policy that looks at images, got policy, .* with --policy"):
        retro_attack(bag, attack, Choice(GREEN.nodes))


def recorded_with(drive, copy, module):
    """A copy of a drive whose launch file names another module for the node policy, with keys of its own."""
    launch = yaml.safe_load(read_attachments(drive)["launch.resolved.yaml"])
    own = {"nodes.calibration_drive": {"vehicle": str(VEHICLE)}, "nodes.expert": {"room": "r.yaml"}}
    launch["nodes"]["policy"] = {"module": module, "config": own.get(module, {})}
    attachments = {**read_attachments(drive), "launch.resolved.yaml": yaml.safe_dump(launch).encode()}
    with BagWriter(copy, attachments, read_info(drive).metadata) as writer:
        for m in read_messages(drive):
            writer.write(m.topic, m.cdr, m.log_ns, m.publish_ns, m.sequence)
    return copy


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--nodes", "policy", "--json", "x.json"], "expected --json and --plot only with --attack"),
        (["--nodes", "policy", "--update-golden"], "expected --golden FILE.mcap with --update-golden"),
        (
            ["--nodes", "policy", "--golden", "x.mcap", "-o", "out"],
            "expected one of --golden, --output and --attack",
        ),
        (["--nodes", "policy", "--tolerance", "1"], "expected --topics and --tolerance only with --golden"),
        (["--nodes", "policy", "--replace", "policy"], "expected NODE=MODULE or NODE=MODULE:CLASS"),
        (["--nodes", "compositor", "--policy", "x.onnx"], "expected the node policy among --nodes"),
        (
            ["--nodes", "compositor", "--golden", "nothing.mcap"],
            "expected a golden bag at nothing.mcap, found none; write it with",
        ),
        (
            ["--nodes", "policy", "--attack", str(CORNER)],
            "expected the node compositor, which draws the attack, among --nodes, got policy; add it",
        ),
        (
            ["--nodes", "compositor", "--attack", str(CORNER)],
            "expected a policy, which publishes /policy/drive, among --nodes, got compositor; add it",
        ),
        ([], "expected at least one node to replay"),
    ],
)
def test_options_that_do_not_go_together_are_one_clear_error(arguments, words):
    with pytest.raises((BagError, ConfigError), match=words):
        cli.app(["bag", "replay", str(CORNER), *arguments], standalone_mode=False)


@pytest.mark.parametrize(
    ("old", "new", "tolerances", "name", "by"),
    [
        (drive_message(1, 0.25, 5), drive_message(1, 0.25, 5), [], None, None),
        (drive_message(1, 0.25, 5), drive_message(1, 0.5, 5), [], "drive.steering_angle", 0.25),
        (drive_message(1, 0.25, 5), drive_message(1, 0.5, 5), ["0.3"], None, None),
        (
            drive_message(1, 0.25, 5),
            drive_message(1, 0.5, 5),
            ["0.3", "/policy/drive:drive.steering_angle=0.2"],
            "drive.steering_angle",
            0.25,
        ),
        (drive_message(1, 0.25, 5), drive_message(1, 0.25, 9), [], "header.stamp.nanosec", 4),
        (drive_message(1, 0.25, 5, "a"), drive_message(1, 0.25, 5, "b"), ["9"], "header.frame_id", None),
        (drive_message(1, np.nan, 5), drive_message(1, np.nan, 5), [], None, None),
        (drive_message(1, 0.0, 5), drive_message(1, np.nan, 5), ["9"], "drive.steering_angle", np.inf),
    ],
)
def test_fields_are_compared_one_by_one(old, new, tolerances, name, by):
    pair = [BagMessage("/policy/drive", encode(message), 1, 1, 0) for message in (old, new)]
    found = compare(*pair, 3, Tolerances.parse(tolerances))
    assert (found and found.name, found and found.by) == (name, by)
    assert type_name(old) == topic_row("/policy/drive").type


def test_another_time_another_count_and_another_topic_are_differences(tmp_path):
    golden = GOLDEN_FOLDER / "corner.golden.mcap"
    messages = list(read_messages(golden))

    def difference(changed):
        comparison = Golden(golden)
        for message in changed:
            comparison.take(message)
        return comparison.finish()

    assert difference(messages) is None
    late = [BagMessage(m.topic, m.cdr, m.log_ns + 5, m.publish_ns, m.sequence) for m in messages]
    assert (difference(late).name, difference(late).by) == ("time", pytest.approx(5e-9))
    missing = difference(messages[:-1])
    assert (missing.index, missing.golden, missing.got) == (11, "there", "not there")
    extra = difference([*messages, pose(2000)])
    assert (extra.topic, extra.golden) == ("/vicon/car", "not there")
    assert "2.0" in extra.text(START_NS)


@pytest.mark.parametrize(
    "text", ["x", "-1", "nan", "/policy/drive=1", "policy:drive=1", "/policy/drive:=1", "inf"]
)
def test_a_tolerance_that_is_none_is_refused(text):
    with pytest.raises(BagError, match="expected VALUE or TOPIC:FIELD=VALUE"):
        Tolerances.parse([text])
