"""Each example runs as its first lines say, and prints figures that are true."""

import ast
import os
import re
import runpy
import shutil
import subprocess
import sys
from importlib.metadata import packages_distributions, requires
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from nodes.bags import read_info, read_messages
from nodes.lab import ros2_policy
from nodes.replaying.nodes import Choice
from nodes.replaying.replay import Replay
from nodes.runtime import decode, stamp_ns

ROOT = Path(__file__).parents[1]
EXAMPLES = ROOT / "examples"
LAUNCH = EXAMPLES / "steer_to_the_light.launch.yaml"
CORNER = ROOT / "tests" / "replay" / "corner.mcap"
DRIVE, DRIVE_TYPE = "/policy/drive", "ackermann_msgs/msg/AckermannDriveStamped"
CORNER_SPEED_MPS = 0.75 * 1000.0 / 1024.0  # as tests/replay/make_golden.py lets the car drive


def run(*command):
    """What a command prints, run in the repository's folder."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    done = subprocess.run(
        [sys.executable, *map(str, command)],
        capture_output=True,
        text=True,
        cwd=ROOT,
        env=environment,
        timeout=600,
    )
    assert done.returncode == 0, done.stderr
    assert "Warning" not in done.stderr
    return done.stdout


def run_here(file, capsys):
    """What an example prints, run as a script in this process: another one would import torch again."""
    runpy.run_path(str(EXAMPLES / file), run_name="__main__")
    out, err = capsys.readouterr()
    assert "Warning" not in err
    return out


def figures(text):
    return [float(number) for number in re.findall(r"(?<![\w.])-?\d+\.\d+", text)]


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_an_example_says_what_it_shows_and_is_listed(file):
    text = file.read_text(encoding="utf-8")
    first, _, rest = (ast.get_docstring(ast.parse(text)) or "").partition("\n")
    assert 20 < len(first) < 130
    assert first.endswith(".")
    commands = re.findall(r"^    (\.venv/bin/.*)$", rest, flags=re.MULTILINE)
    listing = (EXAMPLES / "README.md").read_text(encoding="utf-8")
    (row,) = [line for line in listing.splitlines() if f"[{file.name}]({file.name})" in line]
    assert f"`{commands[0]}`" in row
    assert len(text.splitlines()) < (250 if file.stem.startswith("world_") else 80)


def imported(file):
    """Top-level modules that a file imports."""
    names = set()
    for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom):
            assert node.level == 0
            names.add(node.module.partition(".")[0])
        elif isinstance(node, ast.Import):
            names |= {alias.name.partition(".")[0] for alias in node.names}
    return names


@pytest.mark.parametrize(
    ("file", "arguments", "told"),
    [
        ("read_a_bag", ["no_such_bag"], "no_such_bag does not exist; expected a bag folder"),
        ("ros2_black_box", [], "expected a ROS 2 program that subscribes to /image_raw"),
    ],
)
def test_an_example_that_lacks_its_input_ends_in_one_line(file, arguments, told, monkeypatch, capsys):
    monkeypatch.setattr(ros2_policy, "_FIND_S", 0.1)  # not half a minute
    monkeypatch.setattr(sys, "argv", [file, *arguments])
    with pytest.raises(SystemExit) as ended:
        run_here(f"{file}.py", capsys)
    assert str(ended.value).startswith(f"error: {told}")
    assert len(str(ended.value).splitlines()) == 1


@pytest.fixture(scope="module")
def packages():
    """The installed packages by the modules that they bring."""
    return packages_distributions()


@pytest.mark.parametrize("file", sorted(EXAMPLES.glob("*.py")), ids=lambda file: file.stem)
def test_an_example_imports_only_what_is_installed(file, packages):
    ours = {"advnerf_core", "calibration", "hardware", "nodes"}
    ros2 = {"rclpy", "geometry_msgs", "sensor_msgs"} if file.stem == "ros2_policy" else set()
    declared = {re.match(r"[\w-]+", line)[0].lower() for line in requires("advnerf") if "dev" not in line}
    for name in imported(file) - ours - ros2 - sys.stdlib_module_names:
        assert {package.lower() for package in packages[name]} & declared, name


def test_a_copied_example_runs_in_an_empty_folder(tmp_path):
    """Its imports, and all that it makes itself: nothing of this repository lies beside it."""
    copy = shutil.copy(EXAMPLES / "spiral_method.py", tmp_path)
    environment = {name: value for name, value in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [sys.executable, copy], capture_output=True, text=True, cwd=tmp_path, env=environment, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert figures(done.stdout)[2] > 0.0


def test_the_attack_on_the_line_follower_beats_chance_and_paints_the_board_yellow(capsys):
    printed = run_here("attack_your_policy.py", capsys)
    plain_m, random_m, gradient_m, red, green, blue = figures(printed)
    assert plain_m < 40 * 0.05  # it follows the line
    assert gradient_m > 5 * plain_m
    assert gradient_m > random_m
    assert min(red, green) > blue + 0.2


def test_the_gradient_through_a_renderer_of_ones_own_is_that_of_finite_differences(capsys):
    printed = run_here("attack_through_your_renderer.py", capsys)
    adjoint, numeric, grey_m, attacked_m = figures(printed)
    assert abs(numeric) > 1e-3
    assert adjoint == pytest.approx(numeric, rel=1e-5)
    assert attacked_m > 3 * grey_m


def test_a_method_of_ones_own_runs_beside_the_built_in_ones(capsys):
    spiral_m, random_m, gradient_m = figures(run_here("spiral_method.py", capsys))
    assert gradient_m > random_m > 0.0
    assert spiral_m > 0.0


def test_an_objective_of_ones_own_pulls_the_car_to_the_other_side(capsys):
    value_m, total_m, end_m, left_m, _, left_end_m = figures(run_here("left_objective.py", capsys))
    assert value_m == total_m
    assert end_m < 0.0 < left_end_m
    assert left_m > 0.0


def test_a_network_of_ones_own_learns_to_follow_the_line(capsys):
    error_rad, _ = figures(run_here("my_architecture.py", capsys))
    assert error_rad < 0.03  # a mean label is 0.13 rad


def test_a_bag_that_the_example_writes_itself():
    printed = run("examples/read_a_bag.py")
    assert "302 messages in 5.00 s" in printed
    assert re.search(r"/vicon/car +251 geometry_msgs/msg/PoseStamped", printed)
    assert re.search(rf"{DRIVE} +51 {DRIVE_TYPE}", printed)
    assert "mean speed 0.800 m/s" in printed


def test_a_bag_of_somebody_else():
    printed = run("examples/read_a_bag.py", CORNER)
    assert "132 messages" in printed
    assert f"mean speed {CORNER_SPEED_MPS:.3f} m/s" in printed


@pytest.fixture(scope="module")
def expected():
    """Steering [rad] by stamp [ns], from the pixels of the recording as another reader sees them."""
    found = {}
    with open(CORNER, "rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        for _, _, _, image in reader.iter_decoded_messages(["/camera/image_raw"]):
            pixels = np.frombuffer(bytes(image.data), np.uint8).reshape(image.height, image.width, 3) / 255.0
            half = image.width // 2
            stamp = image.header.stamp.sec * 10**9 + image.header.stamp.nanosec
            found[stamp] = 0.5 * (pixels[:, :half].mean() - pixels[:, half:].mean())
    assert len(found) == 12
    return found


def test_the_node_steers_by_every_image_of_a_recording(expected):
    with Replay(CORNER, Choice(("policy",), launch=LAUNCH)) as replay:
        made = [message for message in replay if message.topic == DRIVE]
    commands = [decode(DRIVE_TYPE, message.cdr) for message in made]
    assert {stamp_ns(command): command.drive.steering_angle for command in commands} == pytest.approx(
        expected
    )
    assert [command.drive.speed for command in commands] == pytest.approx([0.8] * 12)


@pytest.mark.live
def test_the_launch_file_runs_the_node_beside_the_player_and_records_what_it_says(tmp_path, expected):
    run("-m", "nodes.cli", "launch", "examples/steer_to_the_light.launch.yaml", "--folder", tmp_path / "run")
    bag = tmp_path / "run" / "bag"
    counts = {topic.name: topic.count for topic in read_info(bag).topics}
    commands = [decode(DRIVE_TYPE, message.cdr) for message in read_messages(bag, [DRIVE])]
    # A node that wants only the newest image may leave one out on a busy machine.
    assert 10 <= len(commands) == counts[DRIVE] <= 12
    for command in commands:
        assert command.drive.steering_angle == pytest.approx(expected[stamp_ns(command)], abs=1e-6)
    printed = run("examples/read_a_bag.py", bag)
    assert f"/vicon/car{' ' * 10}" in printed
    assert f"mean speed {CORNER_SPEED_MPS:.3f} m/s" in printed
