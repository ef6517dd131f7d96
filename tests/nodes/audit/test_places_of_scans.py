"""The place of an audit from scans: a folder is used, imported, or refused with the command that takes it."""

import json

import numpy as np
import pytest

from advnerf_core.data.transforms import load_transforms
from advnerf_core.errors import AdvnerfError
from nodes.audit.images import posed
from nodes.lab.importing.metric_options import MetricOptions
from tests.support import scan_samples
from tests.support.scan_samples import TRUTH


def length(one, other):
    first, second = (TRUTH[number][:3, 3] for number in (0, 5))
    return MetricOptions(length=(one, other, float(np.linalg.norm(first - second))))


@pytest.mark.parametrize("kind", ["Polycam", "Record3D", "EuRoC", "TUM"])
def test_a_metric_scan_is_a_place(tmp_path, kind):
    there = posed(scan_samples.write(kind, tmp_path / "scan"), tmp_path / "audit", MetricOptions())
    assert (there.kind, there.scale) == ("images", "poses")
    assert there.poses.is_relative_to(tmp_path / "audit")
    assert load_transforms(there.poses, require_all=True).frames


@pytest.mark.parametrize(
    ("kind", "ends"),
    [("LLFF", ("IMG_000.png", "IMG_005.png")), ("nerfstudio", ("frame_00001.png", "frame_00006.png"))],
)
def test_a_scan_without_metres_asks_for_a_length_and_takes_it(tmp_path, kind, ends):
    scan = scan_samples.write(kind, tmp_path / "scan")
    with pytest.raises(AdvnerfError, match="expected a known length"):
        posed(scan, tmp_path / "audit", MetricOptions())
    there = posed(scan, tmp_path / "audit", length(*ends))
    assert there.scale == "length"
    frames = sorted(load_transforms(there.poses).frames, key=lambda each: each.path.name)
    apart = np.linalg.norm(frames[0].T_world_from_camera[:3, 3] - frames[5].T_world_from_camera[:3, 3])
    assert apart == pytest.approx(length(*ends).length[2], rel=1e-9)


def test_other_posed_images_are_used_as_they_are(tmp_path):
    scan = scan_samples.nerfstudio(tmp_path)
    content = json.loads((scan / "transforms.json").read_text())
    content.pop("applied_transform")
    (scan / "transforms.json").write_text(json.dumps(content))
    there = posed(scan, tmp_path / "audit", MetricOptions())
    assert (there.poses, there.scale) == (scan / "transforms.json", "poses")


def test_a_folder_of_nothing_names_what_is_taken(tmp_path):
    with pytest.raises(AdvnerfError, match=r"expected photographs or a scan in it .*poses_bounds\.npy"):
        posed(tmp_path, tmp_path / "audit", MetricOptions())
