"""Real tools and our files: ``lerobot`` and Donkeycar write what we read, and ``lerobot`` loads what we export.

Each lives in an environment of its own, ``venv-lerobot`` and ``venv-donkey`` in the folder of temporary files:
``python -m venv /tmp/venv-lerobot && /tmp/venv-lerobot/bin/pip install lerobot``, and the same with donkeycar.
"""

import json
import subprocess
import tempfile
from hashlib import sha256
from pathlib import Path

import numpy as np
import pytest

from advnerf_core.data.logs.choice import LogChoice
from advnerf_core.data.logs.lerobot_write import CAMERA, write_lerobot
from nodes.lab.policy_data.logs import open_log
from tests.support.logs import GREY, write_tub_2

pytestmark = pytest.mark.slow
WRITE_LEROBOT = """
import sys, numpy as np
from lerobot.datasets.lerobot_dataset import LeRobotDataset
mode = sys.argv[2]
features = {
    "observation.images.front": {"dtype": mode, "shape": (48, 64, 3), "names": ["height", "width", "channels"]},
    "action": {"dtype": "float32", "shape": (2,), "names": ["steering", "throttle"]},
}
data = LeRobotDataset.create("local/x", 10, features, root=sys.argv[1], robot_type="racer", use_videos=mode == "video")
for k in range(12):
    image = np.full((48, 64, 3), 20 * k, np.uint8)
    data.add_frame({"observation.images.front": image, "action": np.array([(k - 6) / 10, 0.5], np.float32), "task": "drive"})
    if k % 4 == 3:
        data.save_episode()
data.finalize()
"""
LOAD_LEROBOT = """
import hashlib, json, sys
from lerobot.datasets.lerobot_dataset import LeRobotDataset
data = LeRobotDataset("local/x", root=sys.argv[1], video_backend=sys.argv[3], delta_timestamps={"action": [0.0, 0.1]})
rows = [data[k] for k in range(len(data))]
print(json.dumps({
    "version": data.meta.info["codebase_version"], "fps": data.fps, "episodes": data.num_episodes, "task": rows[0]["task"],
    "action": [row["action"].reshape(2, -1)[0].tolist() for row in rows],
    "images": [hashlib.sha256((row[sys.argv[2]] * 255).round().byte().permute(1, 2, 0).numpy().tobytes()).hexdigest() for row in rows],
    "statistics": sorted(data.meta.stats),
}))
"""
LOADS_TORCHCODEC = """
try:
    import torchcodec
except Exception:
    print("no")
"""
WRITE_TUB = """
import sys, numpy as np
from donkeycar.parts.tub_v2 import Tub
tub = Tub(sys.argv[1], inputs=["cam/image_array", "user/angle", "user/mode"], types=["image_array", "float", "str"], max_catalog_len=5)
for k in range(12):
    image = np.full((48, 64, 3), 20 * k, np.uint8)
    tub.write_record({"cam/image_array": image, "user/angle": (k - 6) / 10, "user/mode": "user"})
tub.delete_records([2, 7])
tub.close()
"""


def run(environment, program, *words):
    python = Path(tempfile.gettempdir()) / environment / "bin/python"
    if not python.exists():
        pytest.skip(f"needs {python.parent.parent}")
    offline = {"HF_HUB_OFFLINE": "1", "PATH": "/usr/bin:/bin", "HOME": tempfile.gettempdir()}
    command = [str(python), "-c", program, *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=600, env=offline, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    return done.stdout


@pytest.mark.parametrize("mode", ["video", "image"])
def test_what_lerobot_writes_is_read(tmp_path, mode):
    run("venv-lerobot", WRITE_LEROBOT, tmp_path / "set", mode)
    log = open_log(tmp_path / "set")
    frames = list(log.frames())
    assert [frame.image.mean() / GREY for frame in frames] == pytest.approx(range(12), abs=0.2)
    assert [frame.steering for frame in frames] == pytest.approx([(k - 6) / 10 for k in range(12)])


@pytest.mark.parametrize("reader", ["pyav", "torchcodec"])
@pytest.mark.parametrize("size", [(48, 64), (47, 63)])
def test_lerobot_loads_what_is_exported(tmp_path, size, reader):
    if reader == "torchcodec" and run("venv-lerobot", LOADS_TORCHCODEC):
        pytest.skip("torchcodec finds no FFmpeg")
    log = open_log(write_tub_2(tmp_path / "tub", deleted=(5,), size=size), LogChoice(steering_full_rad=0.4))
    done = write_lerobot(log, tmp_path / "set")
    assert (done.frames, done.episodes, done.rate_hz) == (
        11,
        2,
        10,
    )  # an episode ends where a record was deleted
    found = json.loads(run("venv-lerobot", LOAD_LEROBOT, tmp_path / "set", CAMERA, reader).splitlines()[-1])
    kept = [k for k in range(12) if k != 5]
    assert (found["version"], found["fps"], found["episodes"], found["task"]) == ("v3.0", 10, 2, "drive")
    assert np.ravel(found["action"]) == pytest.approx([-0.4 * (k - 6) / 10 for k in kept], abs=1e-6)
    assert found["images"] == [sha256(frame.image.tobytes()).hexdigest() for frame in log.frames()]
    assert {"action", CAMERA} <= set(found["statistics"])


def test_what_donkeycar_writes_is_read(tmp_path):
    run("venv-donkey", WRITE_TUB, tmp_path / "tub")
    log = open_log(tmp_path / "tub")
    kept = [k for k in range(12) if k not in (2, 7)]
    assert [frame.image.mean() / GREY for frame in log.frames()] == pytest.approx(kept, abs=0.2)
    assert log.steering() == pytest.approx([(k - 6) / 10 for k in kept])
    assert log.left_out == {"deleted": 2}
