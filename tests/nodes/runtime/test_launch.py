import os
import re
import signal
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest
import yaml

from nodes.launching.launch import Launch
from nodes.launching.launch_file import load_launch
from nodes.launching.running import active_launches
from nodes.recorder import RecorderConfig
from nodes.runtime.errors import BagError, ConfigError, LaunchError
from tests.support.waiting import wait_for

pytestmark = pytest.mark.live

NODE = """
    import os, signal, subprocess, sys, time
    from pydantic import BaseModel, ConfigDict
    from nodes.runtime.messages import header, types
    from nodes.runtime.node import Node, Out
    from nodes.runtime.process import run_node_main
    from nodes.runtime.errors import NodeFinished

    class Config(BaseModel):
        model_config = ConfigDict(extra="forbid")
        sends: str | None = None
        hears: str | None = None
        then: str = ""
        after_s: float = 0.2
        rate_hz: float = 20.0

    class Probe(Node):
        def __init__(self, config):
            self.config, self.start = config, time.monotonic()
            self.publications = (config.sends,) if config.sends else ()
            self.subscriptions = (config.hears,) if config.hears else ()
            self.tick_rate_hz = config.rate_hz
            if config.then == "deaf":
                subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
        def handle(self, topic, message, info, now):
            return []
        def tick(self, now):
            if self.config.then and time.monotonic() - self.start > self.config.after_s:
                if self.config.then == "fail":
                    raise OSError("the cable is out")
                if self.config.then == "hang":
                    os.kill(os.getpid(), signal.SIGSTOP)
                if self.config.then == "finish":
                    raise NodeFinished
            return []
        def close(self):
            print("closed", flush=True)
            if self.config.then == "deaf":
                time.sleep(60)

    raise SystemExit(run_node_main(Config, lambda config, context: Probe(config)))
"""


@pytest.fixture
def probe(tmp_path, monkeypatch):
    """A module that behaves and misbehaves as configured."""
    (tmp_path / "probe_node.py").write_text(textwrap.dedent(NODE))
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    return "probe_node"


def write(path, **nodes):
    content = {"name": "test", "nodes": {n: {"module": "probe_node", **entry} for n, entry in nodes.items()}}
    path.write_text(yaml.safe_dump(content, sort_keys=False))
    return path


def assert_gone(pids):
    # A zombie of ours is gone for all that matters; psutil would still list it.
    def gone(pid):
        try:
            return psutil.Process(pid).status() == psutil.STATUS_ZOMBIE
        except psutil.NoSuchProcess:
            return True

    wait_for(lambda: all(map(gone, pids)), f"processes {list(pids)} to end")


def test_starts_waits_until_all_are_connected_refuses_a_second_launch_and_stops_all(probe, tmp_path):
    file = write(
        tmp_path / "a.launch.yaml",
        a={"config": {"sends": "/policy/drive"}},
        b={"config": {"hears": "/policy/drive"}},
        c={"config": {"hears": "/policy/drive"}},
    )
    lines = []
    with Launch(file, run_dir=tmp_path / "run", report=lines.append) as launch:
        launch.wait_ready(20)
        assert list(launch.statuses["a"].subscribers) == [2]
        pids = launch.pids
        assert set(pids) == {"a", "b", "c"}
        assert str(tmp_path / "run") in [active["run_dir"] for active in active_launches()]
        with pytest.raises(LaunchError, match=r"in use by the launch of process \d+.*--folder"):
            Launch(file, run_dir=tmp_path / "run").start()
        assert launch.stop() == 0
    assert_gone(pids.values())
    assert (tmp_path / "run/logs/a.log").read_text() == "closed\n"
    assert "all nodes are ready" in lines
    assert yaml.safe_load((tmp_path / "run/launch.resolved.yaml").read_text())["name"] == "test"
    assert str(tmp_path / "run") not in [active["run_dir"] for active in active_launches()]


def test_death_of_a_required_node_stops_all_and_names_it(probe, tmp_path):
    file = write(tmp_path / "a.launch.yaml", good={}, bad={"config": {"then": "fail"}})
    with Launch(file, run_dir=tmp_path / "run") as launch:
        pids = launch.pids
        assert launch.wait(120) == 1
    assert "required node bad ended with exit code 1" in launch.failure
    assert "the cable is out" in launch.failure
    assert_gone(pids.values())


def test_kill_of_a_required_node_is_named_with_its_signal(probe, tmp_path):
    file = write(tmp_path / "a.launch.yaml", good={}, victim={})
    with Launch(file, run_dir=tmp_path / "run") as launch:
        launch.wait_ready(20)
        os.kill(launch.pids["victim"], signal.SIGKILL)
        assert launch.wait(120) == 1
    assert "required node victim was killed by SIGKILL" in launch.failure


def test_hung_node_is_found_and_killed(probe, tmp_path):
    file = write(
        tmp_path / "a.launch.yaml",
        good={},
        sleepy={"hang_timeout_s": 0.6, "config": {"then": "hang", "after_s": 0.6}},
    )
    with Launch(file, run_dir=tmp_path / "run") as launch:
        pids = launch.pids
        assert launch.wait(120) == 1
    assert "required node sleepy hung: no status for 0.6 s" in launch.failure
    assert_gone(pids.values())


def test_node_that_is_not_required_comes_back_and_stays_down_after_too_many_times(probe, tmp_path):
    respawn = {"max_restarts": 1, "delay_s": 0.01}
    crashing = {"required": False, "respawn": respawn, "config": {"then": "fail", "after_s": 0}}
    file = write(tmp_path / "a.launch.yaml", good={}, crashing=crashing)
    lines = []
    with Launch(file, run_dir=tmp_path / "run", report=lines.append) as launch:
        wait_for(lambda: any("it is not restarted" in line for line in lines), "the end of restarts")
        launch.wait_ready(60)
        assert set(launch.pids) == {"good"}
        assert sum("restarted, process" in line for line in lines) == 1
        assert launch.stop() == 0


def test_regular_end_of_a_node_can_end_the_launch(probe, tmp_path):
    file = write(
        tmp_path / "a.launch.yaml", good={}, player={"ends_launch": True, "config": {"then": "finish"}}
    )
    with Launch(file, run_dir=tmp_path / "run") as launch:
        assert launch.wait(120) == 0


def test_deaf_node_and_its_own_child_are_killed_when_asked_twice(probe, tmp_path):
    file = write(tmp_path / "a.launch.yaml", deaf={"config": {"then": "deaf"}})
    with Launch(file, run_dir=tmp_path / "run") as launch:
        launch.wait_ready(20)
        pid = launch.pids["deaf"]
        family = [pid, *(p.pid for p in psutil.Process(pid).children(recursive=True))]
        assert len(family) == 2
        launch.request_stop()
        time.sleep(0.3)
        launch.request_stop(kill=True)
        assert launch.wait(120) == 0
    assert_gone(family)


def test_one_node_is_exchanged_while_the_others_keep_running(probe, tmp_path):
    file = write(
        tmp_path / "a.launch.yaml",
        a={"config": {"sends": "/policy/drive"}},
        b={"config": {"hears": "/policy/drive"}},
        c={},
    )
    with Launch(file, run_dir=tmp_path / "run") as launch:
        launch.wait_ready(60)
        before = launch.pids
        launch.finish("c")
        assert set(launch.pids) == {"a", "b"}
        plan = load_launch(file, ["b.rate_hz=10", "c.rate_hz=5"], launch.run_dir)
        launch.exchange(plan, {"b", "c"})
        launch.wait_ready(60)
        after = launch.pids
        assert after["a"] == before["a"]
        assert after["b"] != before["b"]
        assert set(after) == {"a", "b", "c"}
        assert "rate_hz: 10" in (tmp_path / "run/launch.resolved.yaml").read_text()
        # What was exchanged is watched again.
        os.kill(after["c"], signal.SIGKILL)
        assert launch.wait(120) == 1
        with pytest.raises(LaunchError, match="required node c was killed by SIGKILL"):
            launch.exchange(plan, {"b"})


def test_kill_of_the_supervisor_leaves_no_process(probe, tmp_path):
    file = write(tmp_path / "a.launch.yaml", a={}, b={"config": {"then": "hang", "after_s": 0}}, c={})
    script = (
        "import sys, time; from pathlib import Path; from nodes.launching.launch import Launch\n"
        "launch = Launch(Path(sys.argv[1]), run_dir=Path(sys.argv[2])); launch.start()\n"
        "print(*launch.pids.values(), flush=True); time.sleep(60)"
    )
    command = [sys.executable, "-c", script, file, tmp_path / "run"]
    supervisor = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    pids = [int(word) for word in supervisor.stdout.readline().split()]
    assert len(pids) == 3
    time.sleep(0.5)
    supervisor.kill()
    supervisor.communicate()
    assert_gone(pids)


def test_a_supervisor_that_was_held_up_does_not_kill_its_nodes_for_it(probe, tmp_path):
    """Ctrl-Z and fg stop the launch alone, as its nodes are in groups of their own: they went on, and what they sent is still to be delivered."""
    entries = {f"n{number}": {"hang_timeout_s": 2.0} for number in range(4)}
    file = write(tmp_path / "a.launch.yaml", **entries)
    script = (
        "import os, sys; from pathlib import Path; from nodes.launching.launch import Launch\n"
        # The supervisor's thread says lines as well: print() writes a line in pieces, between which that of another thread can stand.
        "say = lambda *words: os.write(1, (' '.join(map(str, words)) + '\\n').encode())\n"
        "launch = Launch(Path(sys.argv[1]), run_dir=Path(sys.argv[2]), report=say)\n"
        "launch.start(); launch.wait_ready(120); say('ready', *launch.pids.values())\n"
        "sys.stdin.readline(); say('still', *launch.pids.values()); launch.stop(); say(launch.failure)"
    )
    command = [sys.executable, "-c", script, file, tmp_path / "run"]
    supervisor = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    try:
        lines = iter(supervisor.stdout.readline, "")
        pids = next(line.split()[1:] for line in lines if line.startswith("ready"))
        for _ in range(2):
            supervisor.send_signal(signal.SIGSTOP)
            time.sleep(3.0)
            supervisor.send_signal(signal.SIGCONT)
            time.sleep(0.5)
        said = supervisor.communicate("\n", timeout=120)[0]
    finally:
        supervisor.kill()
    assert f"still {' '.join(pids)}" in said
    assert said.count("the launch was held up for ") >= 2
    assert "hung" not in said


def test_wrong_key_in_a_node_names_the_launch_file_and_line(probe, tmp_path):
    file = write(tmp_path / "a.launch.yaml", a={"config": {"rate": 3}})
    line = file.read_text().splitlines().index("      rate: 3") + 1
    with Launch(file, run_dir=tmp_path / "run") as launch:
        assert launch.wait(120) == 1
    assert (
        f"a.launch.yaml:{line}: unknown key rate; valid keys here: after_s, hears, rate_hz" in launch.failure
    )


LAUNCH_TEXT = """\
name: room
params:
  rate_hz: 5
  with_b: false
nodes:
  a:
    module: probe_node
    config: {rate_hz: "${rate_hz}", then: "in ${run_dir}"}
  b:
    module: probe_node
    if: ${with_b}
"""


def test_parameters_conditions_and_overrides(probe, tmp_path):
    file = tmp_path / "p.launch.yaml"
    file.write_text(LAUNCH_TEXT)
    plan = load_launch(file, ["params.rate_hz=7", "a.after_s=2", "a.required=false"], "/run/x")
    assert plan.documents["a"].data == {"rate_hz": 7, "then": "in /run/x", "after_s": 2}
    assert list(plan.nodes) == ["a"]
    assert not plan.nodes["a"].required
    assert list(load_launch(file, ["params.with_b=true"]).nodes) == ["a", "b"]


def test_parameters_may_name_folders_of_the_run_and_other_parameters(probe, tmp_path):
    file = tmp_path / "p.launch.yaml"
    text = LAUNCH_TEXT.replace("in ${run_dir}", "${port}")
    file.write_text(
        text.replace("  with_b: false", "  with_b: false\n  port: ${dev}/vesc\n  dev: ${run_dir}/dev")
    )
    assert load_launch(file, (), "/run/x").documents["a"].data["then"] == "/run/x/dev/vesc"
    set_ = load_launch(file, ["params.port=${run_dir}/other"], "/run/x")
    assert set_.documents["a"].data["then"] == "/run/x/other"
    assert set_.resolved["params"]["port"] == "/run/x/other"
    with pytest.raises(
        ConfigError, match=r"parameter (dev|port) uses itself: (dev -> port -> dev|port -> dev -> port)"
    ):
        load_launch(file, ["params.dev=${port}/x"])


def test_include_is_a_base_that_can_be_changed(probe, tmp_path):
    (tmp_path / "p.launch.yaml").write_text(LAUNCH_TEXT)
    file = tmp_path / "q.launch.yaml"
    file.write_text(
        "name: more\ninclude: [p.launch.yaml]\nnodes:\n  a: {config: {after_s: 9}}\n  b: {if: true}\n"
    )
    plan = load_launch(file)
    assert plan.launch.name == "more"
    assert plan.documents["a"].data["after_s"] == 9
    assert plan.documents["a"].data["rate_hz"] == 5
    assert list(plan.nodes) == ["a", "b"]


def test_record_adds_a_recorder_that_stops_last(probe, tmp_path):
    file = tmp_path / "r.launch.yaml"
    file.write_text(LAUNCH_TEXT + "record: {output: my_bag, max_bag_size_mb: 64}\n")
    plan = load_launch(file)
    recorder = RecorderConfig(**plan.documents["recorder"].data)
    assert (str(recorder.output), recorder.max_bag_size_mb, recorder.max_bag_duration_s) == (
        "my_bag",
        64.0,
        600.0,
    )
    assert plan.nodes["recorder"].stop_last
    assert plan.documents["recorder"].data["statuses_of"] == ["a"]


def test_a_bag_of_an_earlier_launch_is_refused_before_anything_starts(probe, tmp_path):
    file = write(tmp_path / "r.launch.yaml", a={})
    file.write_text(file.read_text() + "record: {output: my_bag}\n")
    bag, lines = tmp_path / "run" / "my_bag", []
    bag.mkdir(parents=True)
    (bag / "my_bag_0.mcap").touch()
    launch = Launch(file, run_dir=tmp_path / "run", report=lines.append)
    with pytest.raises(BagError, match="my_bag exists and is not empty; record to another folder"):
        launch.start()
    assert (launch.pids, lines) == ({}, [])
    assert list((tmp_path / "run").rglob("*.yaml")) == []
    with Launch(file, ["record=false"], tmp_path / "run") as other:  # the folder is free again
        other.wait_ready()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            LAUNCH_TEXT.replace("module: probe_node", "modul: probe_node", 1),
            r":7: unknown key nodes.a.modul; valid keys",
        ),
        (
            LAUNCH_TEXT.replace("probe_node", "nodes.camra", 1),
            r":7: expected a Python module, found none called nodes.camra",
        ),
        (LAUNCH_TEXT.replace("${rate_hz}", "${rat}"), r":8: unknown parameter \$\{rat\}; known are rate_hz"),
        (LAUNCH_TEXT + "  a: {module: x}\n", r":12: nodes.a is given twice"),
        (LAUNCH_TEXT.replace("  a:", "  A-b:"), r":6: expected a node name"),
        (LAUNCH_TEXT.replace("nodes:", "nodes: ["), r":\d+: expected valid YAML"),
        ("just text", r":1: expected a launch file"),
        (
            LAUNCH_TEXT.replace("    config:", "    respawn: {}\n    config:"),
            "must also have required: false",
        ),
    ],
)
def test_wrong_launch_file_is_one_error_with_file_and_line(probe, tmp_path, text, message):
    file = tmp_path / "w.launch.yaml"
    file.write_text(text)
    with pytest.raises(
        ConfigError, match=r"w\.launch\.yaml" + message if message.startswith(":") else message
    ) as caught:
        load_launch(file)
    # A misspelt key may also be a missing one: each problem has its own line.
    first, *others = str(caught.value).split("\n  ")
    assert re.search(message, first)
    assert all(re.match(rf"{file}:\d+: ", line) for line in others)


def test_a_module_in_the_working_folder_is_found_whatever_started_the_command(tmp_path):
    """As `advnerf` does, whose own folder is elsewhere; the node's process is started by ``python -m`` in the working folder."""
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "node_of_mine.py").write_text("")
    write(tmp_path / "mine" / "a.launch.yaml", a={"module": "node_of_mine"})
    script = tmp_path / "command.py"
    script.write_text(
        "from pathlib import Path\nfrom nodes.launching.launch_file import load_launch\n"
        "print(list(load_launch(Path('a.launch.yaml')).nodes))\n"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[3])}
    command = [sys.executable, script]
    done = subprocess.run(
        command, cwd=tmp_path / "mine", env=environment, capture_output=True, text=True, timeout=600
    )
    assert (done.stdout, done.stderr) == ("['a']\n", "")


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("c.x=1", "no node called 'c'; known are a, b, and params"),
        ("nodes.a.config.x=1", "write NODE.KEY=VALUE, without nodes and config"),
        ("params.speed=1", "unknown parameter; known are rate_hz, with_b"),
        ("a", "expected NODE.KEY=VALUE"),
        ("a.x", "expected NODE.KEY=VALUE"),
        (
            "a.hang_timeout_s=never",
            "--set a.hang_timeout_s=never: nodes.a.hang_timeout_s: input should be a valid number",
        ),
    ],
)
def test_wrong_override_is_an_error(probe, tmp_path, override, message):
    file = tmp_path / "p.launch.yaml"
    file.write_text(LAUNCH_TEXT)
    with pytest.raises(ConfigError, match=message):
        load_launch(file, [override])
