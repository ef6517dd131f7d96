"""The little bag of this folder against its golden bag, through the command line and in this process."""

import subprocess
import sys
from pathlib import Path

import make_golden
import pytest
from mcap.reader import make_reader

from nodes.cli import main as cli
from nodes.runtime.errors import BagError

HERE = Path(__file__).parent
BAG, GOLDEN = HERE / make_golden.BAG_NAME, HERE / make_golden.GOLDEN_NAME
NODES = ["--nodes", "compositor,policy", "--replace", "policy=green_policy:GreenPolicy"]
# Other versions of OpenCV round the pixels of the face elsewhere.
PIXELS = ["--tolerance", "/compositor/image:data=2", "--tolerance", "/policy/drive:drive.steering_angle=2e-3"]


def replay(*arguments):
    command = [sys.executable, "-m", "nodes.cli", "bag", "replay", *map(str, arguments)]
    root = str(Path(__file__).parents[2])
    environment = {"PYTHONPATH": f"{root}:{HERE}", "PATH": "/usr/bin:/bin", "HOME": "/tmp"}
    return subprocess.run(command, capture_output=True, text=True, timeout=600, cwd=HERE, env=environment)


def test_command_makes_both_files_again_byte_for_byte(tmp_path):
    bag = make_golden.make_bag(tmp_path)
    assert bag.read_bytes() == BAG.read_bytes()
    first = make_golden.make_golden(bag, tmp_path).read_bytes()
    assert make_golden.make_golden(bag, tmp_path).read_bytes() == first
    assert len(first) == GOLDEN.stat().st_size < 200_000


def test_replay_is_as_golden():
    result = replay(BAG, *NODES, "--golden", GOLDEN, *PIXELS)
    assert (result.returncode, result.stderr) == (0, "")
    assert "36 messages compared" in result.stdout


def test_the_first_difference_is_named():
    result = replay(BAG, *NODES, "--set", "policy.gain_rad=0.011", "--golden", GOLDEN, *PIXELS)
    assert result.returncode == 1
    line = result.stderr.strip()
    assert line.startswith(
        f"error: differs from {GOLDEN}: /policy/drive message 0, 0.043 s into the recording, captured at"
    )
    # One tenth more gain is one tenth more steering.
    old, new = (float(line.split(word)[1].split(",")[0].split(":")[0]) for word in ("was ", "is "))
    assert new / old == pytest.approx(1.1, abs=0.01)
    assert f"drive.steering_angle was {old:.9g}" in line
    assert float(line.split("differs by ")[1].split(",")[0]) == pytest.approx(abs(new - old), rel=1e-5)


def here(*arguments):
    """Exit code of the command, run in this process."""
    return cli.app(["bag", "replay", *map(str, arguments)], standalone_mode=False) or 0


def test_another_face_is_seen_in_the_pixels(capsys):
    assert here(BAG, *NODES, "--set", "compositor.attack=null", "--golden", GOLDEN) == 1
    assert "/compositor/" in capsys.readouterr().err
    with pytest.raises(BagError, match="has no topic /nothing; it has /compositor/attack"):
        here(BAG, *NODES, "--golden", GOLDEN, "--topics", "/nothing")


def test_update_writes_a_bag_that_other_readers_open(tmp_path):
    golden = tmp_path / "new.mcap"
    assert here(BAG, *NODES, "--golden", golden, "--update-golden", "--topics", "/policy/drive") == 0
    with open(golden, "rb") as file:
        topics = [channel.topic for _, channel, _ in make_reader(file, validate_crcs=True).iter_messages()]
    assert topics == ["/policy/drive"] * make_golden.IMAGES
    assert here(BAG, *NODES, "--golden", golden, "--topics", "/policy/drive") == 0
    assert [path.name for path in tmp_path.iterdir()] == ["new.mcap"]
