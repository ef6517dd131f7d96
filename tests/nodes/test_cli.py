import contextlib
import errno
import fcntl
import os
import pty
import re
import signal
import subprocess
import sys
import termios
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.documents import raise_problems
from advnerf_core.files import write_atomically
from nodes.bags.reader import read_info
from nodes.bags.writer import BagWriter
from nodes.cli import main as cli
from nodes.cli.endings import text_for_people
from nodes.launching.watching import describe
from nodes.runtime.clock import SystemClock
from nodes.runtime.errors import BagError
from nodes.runtime.messages import encode, pose_message
from nodes.runtime.node import NodeContext
from nodes.runtime.termination import ending_signals
from tests.support.waiting import wait_for

SENDER = """
    import time
    import numpy as np
    from pydantic import BaseModel, ConfigDict
    from nodes.runtime.messages import pose_message
    from nodes.runtime.node import Node, Out
    from nodes.runtime.process import run_node_main

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid")
        rate_hz: float = 50.0
        breaks: bool = False

    class Sender(Node):
        publications = ("/vicon/car",)
        def __init__(self, config):
            self.tick_rate_hz = config.rate_hz
            if config.breaks:
                raise ValueError("the device does not answer")
        def handle(self, topic, message, info, now):
            return []
        def tick(self, now):
            return [Out("/vicon/car", pose_message(np.eye(4), now.real_ns))]
        def close(self):
            time.sleep(0.5)  # as a car that is braked to a standstill
            print("closed", flush=True)

    raise SystemExit(run_node_main(Config, lambda config, context: Sender(config)))
"""
LAUNCH = """\
name: little
nodes:
  sender:
    module: sender_node
    hang_timeout_s: 30.0  # a test stops it for some seconds
    config: {rate_hz: 50}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    path = tmp_path_factory.mktemp("cli")
    (path / "sender_node.py").write_text(textwrap.dedent(SENDER))
    (path / "little.launch.yaml").write_text(LAUNCH)
    return path


def environment(folder):
    return {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}


def start(folder, *arguments):
    command = [sys.executable, "-m", "nodes.cli", "launch", str(folder / "little.launch.yaml"), *arguments]
    return subprocess.Popen(
        command,
        env=environment(folder),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=os.getcwd(),
    )


@pytest.fixture(scope="module")
def running(folder):
    """A launch at work; its run folder."""
    process = start(folder, "--folder", str(folder / "run"))
    for line in process.stdout:
        if "all nodes are ready" in line:
            break
    yield folder / "run"
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=600)
    assert (process.returncode, but_for_code(errors)) == (0, "")


def test_a_launch_whose_terminal_is_closed_ends_in_order(folder):
    """As a lost ssh connection does: a launch that is killed by it leaves the stop of the car to its motor controller."""
    master, slave = pty.openpty()

    def in_the_terminal():
        signal.signal(signal.SIGHUP, signal.SIG_DFL)
        fcntl.ioctl(0, termios.TIOCSCTTY, 0)

    words = ["launch", str(folder / "little.launch.yaml"), "--folder", str(folder / "closed")]
    process = subprocess.Popen(
        [sys.executable, "-m", "nodes.cli", *words],
        env=environment(folder),
        stdin=slave,
        stdout=slave,
        stderr=slave,
        start_new_session=True,
        preexec_fn=in_the_terminal,
    )
    os.close(slave)
    said = b""
    while b"all nodes are ready" not in said:
        said += os.read(master, 4096)
    os.close(master)
    for _ in range(3):  # the shell of the terminal sends it too
        time.sleep(0.05)
        with contextlib.suppress(ProcessLookupError):
            process.send_signal(signal.SIGHUP)
    assert process.wait(timeout=600) == 0
    assert "closed" in (folder / "closed" / "logs" / "sender.log").read_text()


def test_what_a_program_was_told_to_ignore_does_not_end_it(monkeypatch):
    """``nohup`` starts it with SIGHUP ignored."""
    handlers = {signal.SIGHUP: signal.SIG_DFL, signal.SIGQUIT: signal.SIG_DFL}
    monkeypatch.setattr(signal, "getsignal", handlers.__getitem__)
    assert ending_signals() == (signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)
    handlers[signal.SIGHUP] = signal.SIG_IGN
    assert ending_signals() == (signal.SIGTERM, signal.SIGQUIT)


def but_for_code(errors):
    """What a launch said beside the code of the file that it executes."""
    lines = errors.splitlines(keepends=True)
    assert lines[0].startswith("executes sender_node (sha256 ")
    return "".join(lines[1:])


@pytest.fixture
def command(monkeypatch, capsys):
    """Call the command line as `advnerf` does: exit code, stdout, stderr."""

    def call(*arguments):
        monkeypatch.setattr(sys, "argv", ["advnerf", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            cli.main()
        captured = capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return call


def test_topic_list_names_publishers(running, command):
    code, output, _ = command("car", "topic", "list", "--folder", running)
    assert code == 0
    rows = {line.split()[0]: line.split() for line in output.splitlines()}
    assert rows["/vicon/car"][1:] == ["geometry_msgs/msg/PoseStamped", "100", "Hz", "sender", "0"]
    assert rows["/arm"][-2:] == ["-", "0"]
    assert "/status/sender" in rows


def test_a_node_that_hangs_is_listed_as_silent_with_its_age(running, command):
    top = ("car", "top", "--period", "1.0", "--count", "1", "--folder", running)
    _, output, _ = command(*top)
    rows = {line.split()[0]: line.split() for line in output.splitlines()}
    pid = int(rows["sender"][2])
    assert rows["sender"][1] == "active"
    stopped_s = time.monotonic()
    os.kill(pid, signal.SIGSTOP)
    try:
        time.sleep(0.3)
        code, output, _ = command(*top)
    finally:
        os.kill(pid, signal.SIGCONT)
    silent = (
        rf"(?m)^sender +silent +{pid} .* last status (\d+\.\d) s ago; its process is stopped by a signal *$"
    )
    assert code == 0
    assert 1.0 <= float(re.search(silent, output)[1]) <= time.monotonic() - stopped_s + 10.0
    again = command(*top)[1].splitlines()[1].split()
    assert again[:3] + again[10:] == rows["sender"][:3] + rows["sender"][10:]


def test_a_folder_without_nodes_is_no_empty_table(tmp_path, command):
    code, _, error = command("car", "top", "--period", "0.5", "--folder", tmp_path)
    assert (code, f"expected nodes of a launch in {tmp_path}, found none" in error) == (2, True)


def test_topic_hz_measures_the_rate(running, command):
    code, output, _ = command("car", "topic", "hz", "/vicon/car", "--duration", 1, "--folder", running)
    assert code == 0
    assert float(output.split()[1]) == pytest.approx(50, rel=0.1)
    assert ", 0 lost" in output
    for way in ("capture to publish", "publish to receive", "capture to receive"):
        assert re.search(rf"(?m)^{way}( +\d+\.\d\d ms){{3}} *$", output)


def test_topic_echo_prints_messages(running, command):
    code, output, _ = command("car", "topic", "echo", "/vicon/car", "--count", 2, "--folder", running)
    assert code == 0
    assert output.count("---") == 2
    assert "frame_id: 'world'" in output
    assert "\n    w: 1.0\n" in output


def test_long_arrays_are_cut():
    from nodes.runtime.messages import image_message

    text = describe(image_message(np.zeros((20, 30, 3), np.uint8), 0, "camera"))
    assert "data: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0, ... 1800 in all]" in text


def test_bag_is_recorded_in_several_files_and_played_as_one(running, folder, command):
    bag = folder / "split"
    program = [sys.executable, "-m", "nodes.cli", "bag", "record", "-o", str(bag), "--folder", str(running)]
    recorder = subprocess.Popen(
        [*program, "--max-bag-duration", "0.3", "--max-bag-size", "10"], stdout=subprocess.DEVNULL
    )
    wait_for((bag / "split_2.mcap").exists, "the third file of the bag")
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(120) == 0
    files = len(list(bag.glob("*.mcap")))
    code, output, _ = command("bag", "info", bag / "split_1.mcap")
    assert (code, f" in {files} files, " in output) == (0, True)
    played = ("bag", "play", bag, "--rate", 20, "--no-wait", "--folder", folder / "other")
    assert command(*played)[0] == 0
    (bag / "split_1.mcap").unlink()
    code, _, errors = command("bag", "info", bag)
    assert (code, "the part split_1.mcap of the bag is missing" in " ".join(errors.split())) == (2, True)


def test_bag_is_recorded_described_played_and_repaired(running, folder, command):
    bag = folder / "recorded"
    program = [sys.executable, "-m", "nodes.cli", "bag", "record", "-o", str(bag), "--folder", str(running)]
    recorder = subprocess.Popen(program, stdout=subprocess.DEVNULL)
    wait_for(lambda: sum(f.stat().st_size for f in bag.glob("*.mcap")) >= 20_000, "20 kB on disk")
    recorder.send_signal(signal.SIGINT)
    assert recorder.wait(120) == 0
    code, output, _ = command("bag", "info", bag)
    assert code == 0
    assert "attachments: launch.resolved.yaml" in output
    rows = {line.split()[0]: line.split() for line in output.splitlines()}
    assert rows["/vicon/car"][-1] == "0"
    assert "/status/sender" in rows
    played = ("bag", "play", bag, "--rate", 20, "--no-wait", "--folder", folder / "other")
    assert command(*played)[0] == 0
    whole = (bag / "recorded_0.mcap").read_bytes()
    (bag / "recorded_0.mcap").write_bytes(whole[:-100])
    assert command("bag", "info", bag)[0] == 2
    code, output, _ = command("bag", "repair", bag)
    assert (code, "kept" in output) == (0, True)
    assert read_info(bag).messages > 50
    assert "is intact" in command("bag", "repair", bag)[1]


def test_second_launch_in_the_same_folder_is_one_clear_line(running, folder):
    process = start(folder, "--folder", str(running))
    errors = but_for_code(process.communicate(timeout=600)[1])
    assert process.returncode == 2
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    assert "in use by the launch of process" in errors


def test_dead_node_is_one_line_and_exit_code_1(folder):
    process = start(folder, "--folder", str(folder / "bad"), "--set", "sender.breaks=true")
    errors = but_for_code(process.communicate(timeout=600)[1])
    assert process.returncode == 1
    assert errors.count("\n") == 1
    assert re.search(r"required node sender ended with exit code \d.*the device does not answer", errors)


def test_a_configuration_that_a_node_refuses_starts_no_node(folder):
    process = start(folder, "--folder", str(folder / "refused"), "--set", "sender.speed=3")
    output, errors = process.communicate(timeout=600)
    expected = "error: sender: --set sender.speed=3: unknown key speed; valid keys here: breaks, rate_hz\n"
    assert (process.returncode, but_for_code(errors), output) == (2, expected, "")
    assert not (folder / "refused").exists()


def test_launch_can_end_by_itself(folder):
    process = start(folder, "--folder", str(folder / "short"), "--duration", "0.3")
    errors = but_for_code(process.communicate(timeout=600)[1])
    assert (process.returncode, errors) == (0, "")


def test_launch_check_starts_nothing(folder):
    process = start(folder, "--check", "--set", "sender.rate_hz=3")
    output, errors = process.communicate(timeout=600)
    assert (process.returncode, but_for_code(errors)) == (0, "")
    assert "sender_node" in output
    assert "{'rate_hz': 3}" in output


@pytest.mark.parametrize(
    "words",
    [
        ("bag", "record", "-o", "{}/bag"),
        ("bag", "control", "pause"),
        ("car", "topic", "echo", "/arm"),
        ("car", "top"),
        ("car", "page"),
        ("attack", "cancel"),
    ],
)
def test_no_command_waits_for_a_launch_that_has_ended(tmp_path, command, words):
    (tmp_path / "launch.resolved.yaml").write_text("nodes: {camera: {module: nodes.camera}}\n")
    words = [word.format(tmp_path) for word in words]
    code, _, errors = command(*words, "--folder", tmp_path)
    assert (code, "but all of its nodes have ended; start it" in errors) == (2, True)
    assert not (tmp_path / "bag").exists()


def test_a_recording_without_messages_is_no_success(tmp_path, command, monkeypatch):
    def run(build, name, run_dir):
        build(NodeContext(name, run_dir, SystemClock(), lambda _: 0)).close()
        return 0

    monkeypatch.setattr("nodes.runtime.process.run_node", run)
    code, _, errors = command("bag", "record", "-o", tmp_path / "bag", "--folder", tmp_path)
    assert (code, "recorded 0 messages in" in errors) == (1, True)


def test_a_bag_that_cannot_be_played_leaves_no_folder(tmp_path, command):
    with BagWriter(tmp_path / "bag"):
        pass
    assert command("bag", "play", tmp_path / "bag", "--folder", tmp_path / "new")[0] == 2
    assert not (tmp_path / "new").exists()


def test_launch_check_asks_the_nodes_about_their_configuration(folder):
    process = start(folder, "--check", "--set", "sender.rate=3")
    _, errors = process.communicate(timeout=600)
    assert process.returncode == 2
    assert "--set sender.rate=3: unknown key rate; valid keys here: breaks, rate_hz" in errors


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["bag", "info", "{folder}"], "{folder} is a folder without a bag: it has "),
        (
            ["car", "topic", "echo", "/nothing", "--folder", "{folder}"],
            "unknown topic '/nothing'; known are /camera/image_raw",
        ),
        (["bag", "record", "-o", "{folder}"], "{folder} exists and is not empty; record to another folder"),
        (["car", "topic", "list", "--folder", "{folder}/none"], "expected a run folder at"),
        (["launch", "{folder}/little.launch.yaml", "--set", "x"], "no node called 'x'; known are sender"),
        (
            ["car", "topic", "hz", "/arm", "--duration", "0.1", "--folder", "{folder}"],
            "expected at least two messages of /arm",
        ),
    ],
)
def test_mistake_is_one_line_without_a_traceback(folder, command, arguments, message, monkeypatch):
    monkeypatch.syspath_prepend(folder)
    code, output, errors = command(*(argument.format(folder=folder) for argument in arguments))
    assert (code, output) == (2, "")
    assert errors.startswith("error: ")
    assert errors.count("\n") == 1
    assert message.format(folder=folder) in errors


def test_problems_are_printed_one_a_line(command, monkeypatch):
    monkeypatch.setattr(cli, "app", lambda **_: raise_problems(["a.yaml:1: one", "a.yaml:2: two\nparts"]))
    assert command("doctor")[2] == "error: a.yaml:1: one\n  a.yaml:2: two parts\n"


def test_a_full_disk_is_told_with_the_way_out(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["advnerf"])
    monkeypatch.setattr(cli, "app", lambda **_: Path("/dev/full").write_bytes(bytes(10)))
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert capsys.readouterr().err.startswith(
        "error: the disk is full: free some space or choose another folder"
    )


def test_a_short_write_of_numpy_is_a_full_disk(tmp_path):
    code = """
        import resource, sys
        import numpy as np
        from nodes.cli.endings import text_for_people
        resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
        try:
            np.save(sys.argv[1], np.zeros(4096))
        except OSError as error:
            print(text_for_people(error))
    """
    program = [sys.executable, "-c", textwrap.dedent(code), str(tmp_path / "a.npy")]
    done = subprocess.run(program, capture_output=True, text=True, check=True)
    assert done.stdout.startswith("the disk is full: free some space")


def read_only(path):
    raise OSError(errno.EROFS, "Read-only file system", str(path))


@pytest.mark.parametrize(
    ("make", "path"),
    [
        (lambda path: path.mkdir(parents=True), "/proc/nothing"),
        (lambda path: write_atomically(path, "text"), "/proc/nothing"),
        (read_only, "/mnt/a"),
        (lambda path: read_only(f"{path}.part"), "/mnt/a"),
    ],
)
def test_an_output_that_cannot_be_made_is_told_with_its_option(make, path):
    with pytest.raises(OSError) as error:
        make(Path(path))
    told = text_for_people(error.value)
    assert told.startswith(f"expected a folder that can be written to, got {path} (")
    assert told.endswith("; give another with -o or --folder")


def test_an_input_that_is_missing_is_no_output(tmp_path):
    with pytest.raises(OSError) as error:
        (tmp_path / "nothing").read_bytes()
    assert "written to" not in text_for_people(error.value)


def test_a_bag_on_a_read_only_disk_needs_no_space(tmp_path, monkeypatch):
    monkeypatch.setattr(BagWriter, "_hold_reserve", lambda writer: read_only(writer.folder))
    with pytest.raises(BagError, match=r"written to, got .*/bag \(Read-only file system\); give another"):
        BagWriter(tmp_path / "bag")


def test_mistake_in_an_option_is_told_by_the_option(command, tmp_path):
    code, _, errors = command("bag", "play", tmp_path, "--rate", "-1")
    assert code == 2
    assert "--rate" in errors
    assert command("launch", tmp_path / "nothing.yaml")[0] == 2


def test_debug_shows_the_traceback(monkeypatch, tmp_path):
    from nodes.runtime.errors import BagError

    monkeypatch.setattr(sys, "argv", ["advnerf", "--debug", "bag", "info", str(tmp_path)])
    with pytest.raises(BagError):
        cli.main()


def test_defect_of_ours_keeps_its_traceback(monkeypatch):
    def broken(**_):
        raise IndexError("list index out of range")

    monkeypatch.setattr(cli, "app", broken)
    with pytest.raises(IndexError):
        cli.main()


@pytest.mark.parametrize("code", [None, 0, 1, 3, "no weights"])
def test_a_users_code_that_exits_inside_a_command_is_an_error(command, monkeypatch, tmp_path, code):
    monkeypatch.setattr("nodes.lab.method_check.check_method", lambda *_: sys.exit(code))
    ended, _, errors = command("attack", "method", "check", "random")
    assert ended == 2
    assert f"code of yours to return, it has called sys.exit({code or ''})" in errors


def test_a_reader_that_has_read_enough_is_no_error(command, monkeypatch):
    """As of ``advnerf launch --help | head -1``."""

    def broken(*_):
        try:
            raise BrokenPipeError(errno.EPIPE, "Broken pipe")
        except BrokenPipeError:
            sys.exit(1)  # as rich does

    monkeypatch.setattr("nodes.lab.method_check.check_method", broken)
    assert command("attack", "method", "check", "random") == (1, "", "")


def test_play_refuses_what_is_not_there(command, tmp_path):
    with BagWriter(tmp_path / "bag") as writer:
        writer.write("/vicon/car", encode(pose_message(np.eye(4), 1)), 1, 1, 0)
    code, _, errors = command(
        "bag", "play", tmp_path / "bag", "--topics", "/arm", "--folder", tmp_path / "run"
    )
    assert code == 2
    assert "has no topic /arm; it has /vicon/car" in errors
    assert "traceback" not in errors


def test_a_missing_extra_is_named_with_its_installation(monkeypatch, capsys):
    def without_torch(**_):
        raise ModuleNotFoundError("No module named 'torch'", name="torch")

    monkeypatch.setattr(cli, "app", without_torch)
    with pytest.raises(SystemExit, match="2"):
        cli.main()
    assert "pip install 'advnerf[core]'" in capsys.readouterr().err


def test_a_replay_overwrites_nothing_that_it_was_given(command, tmp_path):
    bag, attack, policy = (tmp_path / name for name in ("drive.mcap", "a.safetensors", "policy.safetensors"))
    for file in (bag, attack, policy):
        file.write_text(file.name)
    given = ("bag", "replay", bag, "--attack", attack, "--policy", policy)
    for output in (("--json", attack), ("--plot", bag), ("--json", policy)):
        code, _, errors = command(*given, *output)
        assert (code, "would be overwritten" in errors) == (2, True), errors
    code, _, errors = command("bag", "replay", bag, "--golden", bag, "--update-golden")
    assert (code, "would be overwritten" in errors) == (2, True), errors
    assert all(file.read_text() == file.name for file in (bag, attack, policy))


@pytest.mark.parametrize(
    ("make", "told"),
    [
        (lambda folder: (folder / "a").mkdir(), "expected a folder at {}/a, or nothing, got a file"),
        (lambda folder: (folder / "a/b").write_text(""), "expected folders on the way to {}/a/b, got a file"),
        (lambda folder: folder.write_text(""), "expected a file at {}, or nothing, got a folder"),
    ],
)
def test_what_is_in_the_way_of_an_output_is_told_in_one_line(tmp_path, make, told):
    (tmp_path / "a").write_text("of the user")
    with pytest.raises(OSError) as error:
        make(tmp_path)
    assert text_for_people(error.value).startswith(told.format(tmp_path))
