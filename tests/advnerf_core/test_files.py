import json
import threading

import numpy as np
import pytest
import torch
from safetensors.numpy import load, save

from advnerf_core.fields.hash_grid import HashGridConfig
from advnerf_core.files import refuse_overwriting, with_sorted_header, write_atomically
from advnerf_core.geometry import Pinhole
from advnerf_core.places import PlaceError
from advnerf_core.policies.pilotnet import PilotNet
from advnerf_core.policies.policy_file import save_policy
from advnerf_core.policies.view import PolicyView
from advnerf_core.scene.field import SceneField, SceneFieldConfig, save_scene


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path):
    target = tmp_path / "kept.json"
    write_atomically(target, json.dumps([1]))
    with pytest.raises(TypeError):
        write_atomically(target, 3)
    assert json.loads(target.read_text()) == [1]
    assert [p.name for p in tmp_path.iterdir()] == ["kept.json"]


def test_several_that_write_one_file_at_once_do_not_disturb_each_other(tmp_path):
    """As two processes do that begin one run."""
    target, failed = tmp_path / "manifest.json", []
    texts = [str(k) * 20_000 for k in range(4)]
    together = threading.Barrier(len(texts))

    def write(text):
        together.wait()
        try:
            for _ in range(50):
                write_atomically(target, text, synced=False)
        except OSError as error:
            failed.append(error)

    threads = [threading.Thread(target=write, args=(text,)) for text in texts]
    for each in threads:
        each.start()
    for each in threads:
        each.join()
    assert not failed
    assert target.read_text() in texts
    assert [p.name for p in tmp_path.iterdir()] == ["manifest.json"]


def test_the_same_content_is_the_same_bytes(tmp_path):
    """The library orders its header by chance, and stages are told apart by the bytes of their files."""
    tensors = {f"t{k}": np.full(k + 1, k, np.float32) for k in range(9)}
    about = {f"key{k}": "é" * k for k in range(9)}
    plain = {save(tensors, about) for _ in range(20)}
    assert len(plain) > 1
    (ordered,) = {with_sorted_header(each) for each in plain}
    assert {name: value.tolist() for name, value in load(ordered).items()} == {
        k: v.tolist() for k, v in tensors.items()
    }
    assert int.from_bytes(ordered[:8], "little") % 8 == 0  # where tensors begin


def test_policies_and_scenes_are_the_same_bytes_when_they_are_saved_again(tmp_path):
    torch.manual_seed(0)
    policy, view = PilotNet().eval(), PolicyView(Pinhole(336, 188, 170.0, 170.0, 168.0, 94.0))
    grid = HashGridConfig(levels=2, features=2, log2_entries=8, coarsest=4, finest=8)
    scene = SceneField(SceneFieldConfig((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), grid=grid, hidden=16))
    written = {"policy": set(), "scene": set()}
    for _ in range(8):
        save_policy(tmp_path / "policy", policy, view, {"b": 1, "a": [2]})
        save_scene(tmp_path / "scene", scene, np.zeros((2, 2, 2), bool), {"b": 1, "a": 2})
        for name, contents in written.items():
            contents.add((tmp_path / name).read_bytes())
    assert {name: len(contents) for name, contents in written.items()} == {"policy": 1, "scene": 1}


def test_nothing_that_was_given_is_overwritten(tmp_path):
    photo, folder, other = tmp_path / "photo.png", tmp_path / "bag", tmp_path / "other.png"
    photo.touch()
    folder.mkdir()
    (folder / "part.mcap").touch()
    (tmp_path / "link.png").symlink_to(photo)
    for outputs, said in [
        ([photo], "would be overwritten"),
        ([folder / ".." / "photo.png"], "would be overwritten"),
        ([tmp_path / "link.png"], "would be overwritten"),
        ([other, photo], "would be overwritten"),
        ([folder / "part.mcap"], "would be overwritten"),
        ([folder], "got the folder"),
        ([other, tmp_path / "." / "other.png"], "two files"),
    ]:
        with pytest.raises(PlaceError, match=said):
            refuse_overwriting((photo, None, folder), outputs)
    with pytest.raises(PlaceError, match="would be overwritten"):
        refuse_overwriting([tmp_path / "link.png"], [photo])
    refuse_overwriting((photo, None, folder), (other, folder / "new.json"))
