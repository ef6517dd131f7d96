import itertools
import json
import re
from collections import Counter
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from advnerf_core.attack.artifact import face_texture, save_attack
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import planar_pose
from benchmarks.host_pair import exchange_keys
from calibration.schema import CalibrationError
from hardware.mocap.vicon import free_udp_port
from nodes.bags.reader import read_attachments, read_messages
from nodes.bags.writer import BagWriter
from nodes.cli.main import app
from nodes.lab.trials.bags import evaluate_bag, find_drives
from nodes.lab.trials.plan import CampaignError, PlannedDrive, finished, make_order, williams_rows
from nodes.lab.trials.series import drive_series, prepare_series, require_shown, summarise
from nodes.launching.launch import Launch
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.messages import encode, header, pose_message, types
from tests.support.faces import face_attack
from tests.support.live.processes import free_ports
from tests.support.messages import filled

ROOT = Path(__file__).parents[2]
LOOPBACK = "127.0.0.1"
START_NS = 1_700_000_000_000_000_000
CONDITIONS = ["none", "random", "gradient"]


def test_the_design_balances_places_and_neighbours():
    for count in (2, 3, 4, 5):
        rows = williams_rows(count)
        places = Counter((place, value) for row in rows for place, value in enumerate(row))
        neighbours = Counter(pair for row in rows for pair in pairwise(row))
        assert len(places) == count * count
        assert len(set(places.values())) == 1
        assert len(neighbours) == count * (count - 1)
        assert len(set(neighbours.values())) == 1


def test_the_order_is_seeded_balanced_and_complete():
    order = make_order(CONDITIONS, 6, 3)
    assert order == make_order(CONDITIONS, 6, 3)
    assert order != make_order(CONDITIONS, 6, 4)
    assert Counter(name for name, _ in order) == dict.fromkeys(CONDITIONS, 6)
    blocks = [order[k : k + 3] for k in range(0, 18, 3)]
    assert all(len({name for name, _ in block}) == 3 for block in blocks)
    first = Counter(block[0][0] for block in blocks)
    assert set(first.values()) == {2}


def attack_file(folder, seed):
    theta = np.random.default_rng(seed).normal(size=(4, 4, 3)).astype(np.float32)
    corners = [[0.0, y, z] for y, z in ((-0.5, 0.5), (0.5, 0.5), (0.5, -0.5), (-0.5, -0.5))]
    attack = face_attack(
        method="random",
        theta=theta,
        texture=face_texture(theta, 16),
        size_m=(1.0, 1.0),
        T_world_from_object=np.eye(4),
        subject="board",
        corners_in_subject=np.array(corners),
        seed=seed,
    )
    save_attack(folder / f"{seed}.safetensors", attack)
    return folder / f"{seed}.safetensors", attack.attack_id


def series(tmp_path, folder="trials", **changes):
    files = [attack_file(tmp_path, seed)[0] for seed in range(3)]
    arguments = {
        "attacks": {"random": files[:1], "gradient": files[1:]},
        "repeats": 3,
        "seed": 0,
        "ticks": 60,
        **changes,
    }
    calibration = [f"params.calibration={ROOT / 'calibration' / 'twin'}"]
    return prepare_series(
        ROOT / "launch" / "green_screen.launch.yaml", calibration, tmp_path / folder, **arguments
    )


def test_attack_files_of_a_condition_take_turns_and_the_plan_is_kept(tmp_path):
    made = series(tmp_path)
    by_repeat = {(run.condition, run.repeat): run.attack_id for run in made.plan.runs}
    ids = [attack_file(tmp_path, seed)[1] for seed in range(3)]
    assert [by_repeat["gradient", k] for k in range(3)] == [ids[1], ids[2], ids[1]]
    assert {by_repeat["random", k] for k in range(3)} == {ids[0]}
    assert {by_repeat["none", k] for k in range(3)} == {""}
    assert set(made.nodes) == {"twin", "camera", "vicon", "compositor", "policy", "safety", "motor"}
    assert series(tmp_path).plan == made.plan  # another day
    assert made.plan.start_pose == (-1.1, -2.0, 0.0)


@pytest.mark.parametrize(
    "changed", [{"seed": 1}, {"ticks": 40}, {"repeats": 4}, {"start_pose": (0.0, -2.0, 0.0)}]
)
def test_a_folder_is_finished_as_it_was_begun(tmp_path, changed):
    series(tmp_path)
    with pytest.raises(CampaignError, match="the settings of a series cannot change"):
        series(tmp_path, **changed)


def test_what_is_done_is_found_again_and_a_damaged_result_named(tmp_path):
    made = series(tmp_path)
    name = made.plan.runs[2].name
    (made.folder / f"{name}.json").write_text(json.dumps({"condition": "none"}))
    assert list(finished(made.folder, made.plan)) == [name]
    (made.folder / f"{name}.json").write_text("{")
    with pytest.raises(CampaignError, match="remove it to drive that run again"):
        finished(made.folder, made.plan)


def test_a_launch_file_that_cannot_be_measured_is_refused(tmp_path):
    (tmp_path / "a.launch.yaml").write_text("name: a\nnodes:\n  camera: {module: nodes.camera}\n")
    with pytest.raises(ConfigError, match="expected a node safety with a room"):
        prepare_series(tmp_path / "a.launch.yaml", [], tmp_path / "t", {}, 1, 0, 60)


def two_hosts(tmp_path, host, *overrides):
    settings = [f"params.calibration={ROOT / 'calibration' / 'twin'}", "keys=keys", *overrides]
    return prepare_series(
        ROOT / "launch" / "two_hosts.launch.yaml", settings, tmp_path / "t", {}, 2, 0, 60, None, host
    )


def test_of_two_hosts_the_operators_drives_the_trials_and_waits_for_the_nodes_of_both(tmp_path):
    made = two_hosts(tmp_path, "workstation")
    assert made.plan.host == "workstation"
    assert set(made.nodes) == {"camera", "vicon", "compositor", "policy", "safety", "motor"}
    assert made.plan.start_pose == (-1.1, -2.0, 0.0)
    assert json.loads((tmp_path / "t" / "plan.json").read_text())["host"] == "workstation"
    with pytest.raises(CampaignError, match="trials with another host"):
        two_hosts(tmp_path, "all")


@pytest.mark.parametrize(
    ("host", "overrides", "words"),
    [
        (None, [], "expected --host with one of"),
        ("tractor", [], "expected --host with one of"),
        ("robot", [], "trials to run on the operator's host, workstation; got --host robot"),
        (
            "workstation",
            ["record.host=robot"],
            "expected the bags of trials on workstation, but robot records",
        ),
        ("workstation", ["record=false"], "expected the key record"),
    ],
)
def test_a_host_from_which_no_trial_can_be_driven_is_refused(tmp_path, host, overrides, words):
    with pytest.raises(ConfigError, match=words):
        two_hosts(tmp_path, host, *overrides)


def test_the_table_divides_by_no_attack():
    def result(condition, total):
        found = {"condition": condition, "total_cte_m": total, "off_track": total > 9, "stopped_early": ""}
        return {**found, "spoiled": ["late"] * (total > 11)}

    rows = summarise(
        [result("gradient", 10.0), result("none", 2.0), result("gradient", 14.0), result("none", 4.0)]
    )
    assert [row["condition"] for row in rows] == ["none", "gradient"]
    assert rows[1]["mean_m"] == 12.0
    assert rows[1]["std_m"] == pytest.approx(np.sqrt(8.0))
    assert (rows[1]["ratio"], rows[1]["off_track"]) == (4.0, 2)
    assert [row["spoiled_tries"] for row in rows] == [0, 1]
    assert summarise([result("gradient", 10.0)])[0]["ratio"] is None


def write_bag(folder, drives, offset_m=0.1, rate_hz=100):
    """Straight drives along the bottom of the track, each (stand, drive, reason) in seconds, at 0.8 m/s."""
    room = (ROOT / "calibration" / "twin" / "room.yaml").read_bytes()
    writer = BagWriter(folder / "bag", attachments={"room.yaml": room})
    t, sequence = 0.0, 0

    def put(topic, message):
        nonlocal sequence
        sequence += 1
        at_ns = START_NS + round(t * 1e9)
        writer.write(topic, encode(message), at_ns, at_ns, sequence)

    def state(armed, reason=""):
        stamp = START_NS + round(t * 1e9)
        put(
            "/safety/state",
            filled(types.SafetyState, header=header(stamp), armed=armed, stopping=not armed, reason=reason),
        )

    for stand_s, drive_s, reason in drives:
        state(False, "not armed since the start")
        for k in range(round((stand_s + drive_s) * rate_hz)):
            armed_from = round(stand_s * rate_hz) - 5
            if k == armed_from or k % (rate_hz // 10) == 0:
                state(k >= armed_from, "" if k >= armed_from else "not armed since the start")
            t += 1.0 / rate_hz
            x = -0.9 + 0.8 * max(0.0, (k + 1) / rate_hz - stand_s)
            put("/vicon/car", pose_message(planar_pose(x, -2.0 + offset_m, 0.0), START_NS + round(t * 1e9)))
        state(False, reason)
    for _ in range(rate_hz):
        t += 1.0 / rate_hz
        put("/vicon/car", pose_message(planar_pose(x, -2.0 + offset_m, 0.0), START_NS + round(t * 1e9)))
    writer.close()
    return folder / "bag"


def test_a_drive_ends_where_the_clock_of_the_recorder_was_set(tmp_path, capsys):
    drives = [(1.0, 2.2, "outside the fence")]
    (straight,) = find_drives(write_bag(tmp_path / "straight", drives))
    with BagWriter(tmp_path / "jump") as writer:
        for number, each in enumerate(read_messages(tmp_path / "straight" / "bag")):
            log_ns = each.log_ns + 7200 * NS_PER_S * (each.log_ns > straight.start_real_ns + NS_PER_S)
            writer.write(each.topic, each.cdr, log_ns, log_ns, number)
    (span,) = find_drives(tmp_path / "jump")
    assert span.start_real_ns == straight.start_real_ns
    assert (span.end_real_ns - span.start_real_ns) / NS_PER_S == pytest.approx(1.0, abs=0.05)
    assert span.reason.startswith("log time jumps by 2 hours after message ")
    assert span.reason in capsys.readouterr().err


def test_the_numbers_of_a_bag_follow_from_the_bag_alone(tmp_path):
    bag = write_bag(
        tmp_path, [(1.0, 2.2, "disarmed by trial: trial is over"), (0.5, 1.0, "the car is outside the fence")]
    )
    whole, broken = evaluate_bag(bag, None, ticks=20)
    # On the straight the error is the offset at each of the 20 ticks, and the held one after an early stop too.
    assert whole["total_cte_m"] == pytest.approx(20 * 0.1, abs=1e-6)
    assert (whole["stopped_early"], whole["off_track"]) == ("", False)
    assert broken["total_cte_m"] == pytest.approx(20 * 0.1, abs=1e-6)
    assert broken["stopped_early"] == "the car is outside the fence"
    assert [(each["counts"], each["driven_ticks"]) for each in (whole, broken)] == [(True, 20), (True, 9)]
    first = find_drives(bag)[0]
    # 1 cm at 0.8 m/s is passed with the second pose after the start.
    assert (first.start_real_ns - START_NS) / 1e9 == pytest.approx(1.02, abs=0.011)
    np.testing.assert_allclose(np.array(whole["states"])[:, 1], -1.9, atol=1e-9)
    path = DrivingPath.rounded_square(4.0, 1.1)
    np.testing.assert_allclose(
        whole["cte_m"], path.project(np.array(whole["states"])[:, :2]).cte_m, atol=1e-9
    )


def copied(bag, folder, keep=lambda message: True, more=()):
    """A bag again, without some of its messages and with others ``(topic, message, ns)``, in the order of time."""
    with BagWriter(folder, read_attachments(bag)) as writer:
        old = [(each.log_ns, each.topic, each.cdr) for each in read_messages(bag) if keep(each)]
        new = [(at_ns, topic, encode(message)) for topic, message, at_ns in more]
        for number, (at_ns, topic, cdr) in enumerate(sorted([*old, *new], key=lambda each: each[0])):
            writer.write(topic, cdr, at_ns, at_ns, number)
    return folder


def let_go(at_ns, why):
    act = filled(types.OperatorAct, header=header(at_ns), act="let_go", detail=why, granted=True)
    return "/operator/act", act, at_ns


@pytest.mark.parametrize(
    ("reason", "page", "said"),
    [
        ("no command from the policy for 0.22 s", "", "no result: no command from the policy for 0.22 s"),
        ("the button is not held", "", "the button is not held"),
        (
            "the button is not held",
            "the page has not answered for 0.26 s",
            "no result: the page has not answered for 0.26 s",
        ),
        ("the button is not held", "the trial was ended", "the trial was ended"),
        ("the car is outside the fence", "the trial was ended", "the car is outside the fence"),
    ],
)
def test_a_drive_that_a_fault_of_the_stack_ended_is_no_result_of_a_bag_either(tmp_path, reason, page, said):
    """As on the page and in ``car trial``, by one rule; the page knows better why a button was not held."""
    bag = write_bag(tmp_path, [(1.0, 0.99, reason), (0.5, 2.2, "disarmed by trial: trial is over")])
    if page:
        at_ns = find_drives(bag)[0].end_real_ns - NS_PER_S // 50
        earlier = let_go(at_ns - 3 * NS_PER_S, "the picture on the page is 1.2 s old")
        bag = copied(bag, tmp_path / "told", more=[earlier, let_go(at_ns, page)])
    ended, whole = evaluate_bag(bag, None, ticks=20)
    counts = not said.startswith("no result: ")
    assert ended["stopped_early"] == said.removeprefix("no result: ")
    assert (ended["counts"], ended["driven_ticks"], len(ended["states"])) == (counts, 9, 21)
    assert (ended["total_cte_m"] is None) == (ended["off_track"] is None) == (not counts)
    assert whole["counts"]
    shown = CliRunner().invoke(app, ["bag", "evaluate", str(bag), "--ticks", "20"], env={"COLUMNS": "240"})
    assert f"{said}, after 9 ticks" in shown.stdout


@pytest.mark.parametrize("returns", [True, False])
def test_a_drive_ends_where_the_safety_node_falls_silent(tmp_path, returns):
    """Frozen, it says nothing, the motor node brakes, and the car that stands was measured as if it had been driven to the end."""
    bag = write_bag(tmp_path, [(1.0, 1.5, "the safety node was held up for 1.00 s")])
    start_ns = find_drives(bag)[0].start_real_ns
    frozen = range(start_ns + NS_PER_S // 2, start_ns + NS_PER_S * (14 if returns else 15) // 10)
    held = copied(
        bag, tmp_path / "held", lambda each: each.topic != "/safety/state" or each.log_ns not in frozen
    )
    (found,) = evaluate_bag(held, None, ticks=14)
    assert (found["counts"], found["total_cte_m"]) == (False, None)
    assert found["driven_ticks"] == 9  # half a second after its last report
    silent_s = "1.0" if returns else "2.0"  # until its next report, or the last pose
    assert found["stopped_early"] == f"no message from the safety node for {silent_s} s"


def test_a_bag_that_cannot_be_evaluated_leaves_the_others_their_rows(tmp_path):
    good = write_bag(tmp_path, [(1.0, 2.2, "disarmed by trial: trial is over")])
    bad = copied(good, tmp_path / "bad", lambda each: each.topic != "/safety/state")
    arguments = ["bag", "evaluate", str(bad), str(good), "--ticks", "20"]
    shown = CliRunner().invoke(app, arguments, env={"COLUMNS": "240"})
    assert str(good) in shown.stdout
    assert "agree" in shown.stdout
    assert re.fullmatch(
        r"1 of 2 bags were not evaluated: expected /safety/state, .*", str(shown.exception), re.DOTALL
    )
    rows = CliRunner().invoke(app, [*arguments, "--json"]).stdout.splitlines()
    assert [json.loads(row)["bag"] for row in rows if row.startswith("{")] == [str(good)]


def test_a_drive_whose_end_is_not_in_the_bag_is_no_result(tmp_path):
    bag = write_bag(tmp_path, [(1.0, 2.2, "disarmed by trial: trial is over")])
    end_ns = find_drives(bag)[0].start_real_ns + NS_PER_S
    (cut,) = evaluate_bag(copied(bag, tmp_path / "cut", lambda each: each.log_ns < end_ns), None, ticks=20)
    assert (cut["counts"], cut["total_cte_m"]) == (False, None)
    assert cut["stopped_early"] == "the bag ends while the car drives"


def test_a_drive_whose_beginning_is_not_in_the_bag_is_left_out(tmp_path, capsys):
    """Its start would be wherever the recording began."""
    drives = [(2.0, 2.2, "disarmed by trial: trial is over"), (0.5, 2.2, "disarmed by trial: trial is over")]
    bag = write_bag(tmp_path, drives)
    expected = evaluate_bag(bag, None, ticks=20)
    first, second = find_drives(bag)

    def later(begin_ns, name):
        state = filled(types.SafetyState, header=header(begin_ns), armed=True)
        kept = copied(
            bag, tmp_path / name, lambda each: each.log_ns >= begin_ns, [("/safety/state", state, begin_ns)]
        )
        return evaluate_bag(kept, None, ticks=20)

    (found,) = later(first.start_real_ns + NS_PER_S, "middle")
    assert found["states"] == expected[1]["states"]
    assert "the recording began while the car was driving" in capsys.readouterr().err
    # A car that was armed before, and stood, has its beginning in the bag.
    assert len(later(first.start_real_ns - 3 * NS_PER_S // 2, "armed")) == 2
    only = copied(
        bag,
        tmp_path / "only",
        lambda each: first.start_real_ns + NS_PER_S <= each.log_ns < second.start_real_ns - NS_PER_S // 4,
        [
            (
                "/safety/state",
                filled(types.SafetyState, armed=True, header=header(first.start_real_ns + NS_PER_S)),
                first.start_real_ns + NS_PER_S,
            )
        ],
    )
    with pytest.raises(BagError, match="expected a drive from its beginning"):
        evaluate_bag(only, None, ticks=20)


@pytest.mark.parametrize("topic", ["/compositor/attack", "/monitor/attack"])
def test_each_drive_of_a_bag_has_the_attacks_that_were_shown_in_it(tmp_path, topic):
    """A label of an image is for that image; a screen is labelled when its content changes."""
    drives = [(1.0, 2.2, "disarmed by trial: trial is over")] * 3
    bag = write_bag(tmp_path, drives)
    spans = find_drives(bag)

    def label(at_ns, attack_id, drawn):
        return (
            topic,
            types.AttackStamp(header=header(at_ns), attack_id=attack_id, drawn=drawn, reason=""),
            at_ns,
        )

    first, second, third = ((span.start_real_ns, span.end_real_ns) for span in spans)
    if topic == "/compositor/attack":
        labels = [label(at, "aaaa", at < first[1]) for at in range(first[0], second[1], NS_PER_S // 10)]
        labels += [label(at, "bbbb", True) for at in range(third[0], third[1], NS_PER_S // 10)]
    else:
        half_s = NS_PER_S // 2
        labels = [label(first[0] - half_s, "aaaa", True), label(first[1] + half_s // 10, "aaaa", False)]
        labels += [label(third[0] - half_s, "bbbb", True)]
    shown = copied(bag, tmp_path / "shown", more=labels)
    assert [drive["attack_ids"] for drive in evaluate_bag(shown, None, ticks=20)] == [["aaaa"], [], ["bbbb"]]


def test_a_drive_without_its_attack_is_refused_with_the_reason_of_most_labels(tmp_path):
    """Those from before the drive, while the car was not armed, say nothing about it."""
    bag = write_bag(tmp_path, [(1.0, 2.2, "disarmed by trial: trial is over")])
    (span,) = find_drives(bag)
    reasons = ["not armed"] * 40 + ["out of view"] * 5 + ["turned away"] * 15
    first_ns = span.start_real_ns - 40 * NS_PER_S // 10
    labels = [
        (
            "/compositor/attack",
            types.AttackStamp(header=header(at), attack_id="aaaa", drawn=False, reason=reason),
            at,
        )
        for at, reason in zip(itertools.count(first_ns, NS_PER_S // 10), reasons, strict=False)
    ]
    labelled = copied(bag, tmp_path / "labelled", more=labels)
    (found,) = evaluate_bag(labelled, None, ticks=20)
    run = PlannedDrive(1, "g", 0, "a.safetensors", "aaaa")
    with pytest.raises(CampaignError, match=r"got \[\]: 15 of 20 labels say 'turned away'; check compositor"):
        require_shown(run, found, labelled)
    require_shown(replace(run, attack_id=""), found, labelled)


def test_a_car_that_is_carried_away_after_its_drive_stopped_costs_no_drive(tmp_path):
    """It had cost all drives of the bag, by a traceback."""
    drives = [(1.0, 1.0, "the car is outside the fence"), (3.0, 2.2, "disarmed by trial: trial is over")]
    bag = write_bag(tmp_path, drives)
    stop_ns = find_drives(bag)[0].end_real_ns
    hidden = range(stop_ns + NS_PER_S // 5, stop_ns + 2 * NS_PER_S)
    gap = copied(bag, tmp_path / "gap", lambda each: each.topic != "/vicon/car" or each.log_ns not in hidden)
    expected, found = (evaluate_bag(each, None, ticks=20) for each in (bag, gap))
    assert [drive["total_cte_m"] for drive in found] == [drive["total_cte_m"] for drive in expected]


RELAYED = """\
nodes:
  safety: {module: nodes.safety, if: false}
  gateway: {module: nodes.gateway, config: {imports: [/vicon/car, /safety/state, /odom]}}
"""


@pytest.mark.parametrize(
    ("relayed", "others_heard", "why"),
    [
        (True, False, "the recorder received nothing from the other host for 0.8 s"),
        (True, True, "the car was not tracked for 0.8 s"),
        (False, False, "the car was not tracked for 0.8 s"),
    ],
)
def test_poses_that_are_missing_cost_their_drive_alone_and_the_cause_is_told(
    tmp_path, monkeypatch, relayed, others_heard, why
):
    """As on the page, where they are no result; they had cost all drives of the bag."""
    drives = [
        (1.0, 2.2, "disarmed by trial: trial is over"),
        (1.0, 1.0, "the car is outside the fence"),
        (3.0, 2.2, "disarmed by trial: trial is over"),
    ]
    bag = write_bag(tmp_path, drives)
    expected, second = evaluate_bag(bag, None, ticks=20), find_drives(bag)[1]
    gap = range(second.end_real_ns - NS_PER_S * 9 // 10, second.end_real_ns - NS_PER_S // 10)
    files = {**read_attachments(bag), **({"launch.resolved.yaml": RELAYED.encode()} if relayed else {})}
    hidden = ("/vicon/car",) if others_heard or not relayed else ("/vicon/car", "/safety/state")
    with BagWriter(tmp_path / "lost", files) as writer:
        for number, each in enumerate(read_messages(bag)):
            if each.topic not in hidden or each.log_ns not in gap:
                writer.write(each.topic, each.cdr, each.log_ns, each.log_ns, number)
            elif others_heard:
                odom = encode(filled(types.Odometry, header=header(each.log_ns)))
                writer.write("/odom", odom, each.log_ns, each.log_ns, number)
    before, lost, after = evaluate_bag(tmp_path / "lost", None, ticks=20)
    assert [before, after] == [
        {**drive, "bag": str(tmp_path / "lost")} for drive in (expected[0], expected[2])
    ]
    assert (lost["counts"], lost["total_cte_m"], lost["states"]) == (False, None, [])
    # The drive begins 1 cm behind the start of motion, and the gap less than a tick later.
    assert (lost["stopped_early"], lost["driven_ticks"]) == (why, 0)
    monkeypatch.chdir(tmp_path)
    shown = CliRunner().invoke(app, ["bag", "evaluate", "lost", "--ticks", "20"])
    assert f"no result: {why}, after 0 ticks" in shown.stdout


def test_poses_that_are_missing_after_the_stop_cost_nothing(tmp_path):
    bag = write_bag(tmp_path, [(1.0, 1.0, "the car is outside the fence"), (3.0, 2.2, "disarmed by me")])
    stop_ns = find_drives(bag)[0].end_real_ns
    hidden = range(stop_ns + 1, stop_ns + 2 * NS_PER_S)
    gap = copied(bag, tmp_path / "gap", lambda each: each.topic != "/vicon/car" or each.log_ns not in hidden)
    expected, found = (evaluate_bag(each, None, ticks=20) for each in (bag, gap))
    assert [drive["total_cte_m"] for drive in found] == [drive["total_cte_m"] for drive in expected]


def test_numbers_of_a_bag_without_checksums_are_unchecked(tmp_path):
    bag = write_bag(tmp_path, [(1.0, 2.2, "disarmed by trial: trial is over")])
    (checked,) = evaluate_bag(bag, None, ticks=20)
    assert checked["unchecked"] == ""
    path = bag / "bag.mcap"
    content = bytearray(path.read_bytes())
    at = 8
    while content[at] != 0x0F:  # DataEnd
        if content[at] == 0x06:  # Chunk; its checksum behind two times and a size
            content[at + 33 : at + 37] = bytes(4)
        at += 9 + int.from_bytes(content[at + 1 : at + 9], "little")
    path.write_bytes(content)
    (unchecked,) = evaluate_bag(bag, None, ticks=20)
    assert "chunks have no checksum" in unchecked["unchecked"]
    assert unchecked["total_cte_m"] == checked["total_cte_m"]
    shown = CliRunner().invoke(app, ["bag", "evaluate", str(bag), "--ticks", "20"], env={"COLUMNS": "240"})
    assert "unchecked" in shown.stdout
    rows = summarise([{**unchecked, "condition": "none"}, {**checked, "condition": "none"}])
    assert rows[0]["unchecked"] == 1


def test_bags_without_a_drive_say_what_they_lack(tmp_path):
    writer = BagWriter(tmp_path / "empty", {}, {})
    writer.write("/vicon/car", encode(pose_message(np.eye(4), START_NS)), START_NS, START_NS, 1)
    writer.close()
    with pytest.raises(BagError, match=r"expected room.yaml attached to"):
        evaluate_bag(tmp_path / "empty", None)
    with pytest.raises(BagError, match="got no /safety/state"):
        find_drives(tmp_path / "empty")
    BagWriter(tmp_path / "damaged", {"room.yaml": b"kind: room\npath: [\n"}, {}).close()
    with pytest.raises(CalibrationError, match=r"room.yaml in .*/damaged:\d: expected valid YAML"):
        evaluate_bag(tmp_path / "damaged", None)


@pytest.mark.slow
def test_a_series_on_the_twin_counts_what_its_bags_say_and_goes_on(tmp_path):
    from nodes.lab.trials.series import drive_series

    calibration = [
        f"params.calibration={ROOT / 'calibration' / 'twin'}",
        f"params.vicon_port={free_udp_port()}",
    ]
    stands_in = ["policy.module=tests.support.live.straight_policy", "policy.speed_mps=0.5"]
    made = prepare_series(
        ROOT / "launch" / "green_screen.launch.yaml",
        calibration + stands_in,
        tmp_path / "t",
        {"random": [attack_file(tmp_path, 0)[0]]},
        1,
        0,
        10,
    )
    begun = []
    drive_series(made, 60.0, lambda run: begun.append(run.name), print)
    assert len(begun) == 2
    for run in made.plan.runs:
        (again,) = evaluate_bag(made.folder / run.name / "bag", None, 10)
        assert again["total_cte_m"] == made.results[run.name]["total_cte_m"]
        assert again["attack_ids"] == ([run.attack_id] if run.attack_id else [])
    (made.folder / f"{begun[1]}.json").unlink()
    drive_series(made, 60.0, lambda run: begun.append(run.name), print)
    assert begun[2:] == [begun[1]]


@pytest.mark.slow  # two launches: the car with its lab, and the workstation from which it is driven
def test_trials_from_the_workstation_drive_the_car_of_the_other_host(tmp_path):
    file, vicon = ROOT / "launch" / "two_hosts.launch.yaml", free_udp_port()
    watch, drive = free_ports(2)
    keys = {host: f"keys={folder}" for host, folder in exchange_keys(tmp_path).items()}
    shared = [
        f"params.calibration={ROOT / 'calibration' / 'twin'}",
        "params.image_topic=/camera/image_raw",
        f"params.vicon_port={vicon}",
        "policy.module=tests.support.live.straight_policy",
        "policy.speed_mps=0.6",
        f"hosts.robot.watch_port={watch}",
        f"hosts.robot.drive_port={drive}",
    ]
    car = [
        "twin.if=true",
        "camera.source={kind: socket, path: '${socket_dir}/frames'}",
        "motor.port=${run_dir}/vesc",
    ]
    ready = ["safety.nodes=[camera, vicon, policy, motor]"]
    with Launch(file, [*shared, *car, *ready, keys["robot"]], tmp_path / "car", host="robot"):
        series = prepare_series(
            file, [*shared, keys["workstation"]], tmp_path / "trials", {}, 2, 0, 15, None, "workstation"
        )
        drive_series(series, 90.0, lambda run: None, print)
    results = list(series.results.values())
    assert [result["condition"] for result in results] == ["none", "none"]
    assert all(result["peer"].startswith("TWIN") or "TWIN" in result["peer"] for result in results)
    assert all(result["stopped_early"] == "" for result in results)
    assert all(abs(result["states"][-1][0] - result["states"][0][0]) > 0.4 for result in results)
    assert not (tmp_path / "trials" / "001_none_0" / "logs" / "safety.log").exists()  # that one is on the car
