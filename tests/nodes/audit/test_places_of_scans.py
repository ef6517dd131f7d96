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


def test_other_posed_images_are_used_as_they_are_if_they_are_said_to_be_in_metres(tmp_path):
    scan, ends = scan_samples.nerfstudio(tmp_path), ("frame_00001.png", "frame_00006.png")
    with pytest.raises(
        AdvnerfError, match=r"expected a known length, .* --in-metres if posed photographs are"
    ):
        posed(scan, tmp_path / "audit", MetricOptions())
    there = posed(scan, tmp_path / "audit", MetricOptions(), in_metres=True)
    assert (there.poses, there.scale) == (scan / "transforms.json", "poses")
    with pytest.raises(AdvnerfError, match="expected one source of the metre, got --in-metres and another"):
        posed(scan, tmp_path / "audit", length(*ends), in_metres=True)
    with pytest.raises(
        AdvnerfError, match=r"--in-metres: expected photographs with poses \(transforms\.json\)"
    ):
        posed(
            scan_samples.write("LLFF", tmp_path / "llff"), tmp_path / "audit", MetricOptions(), in_metres=True
        )


def test_a_length_that_is_not_needed_is_refused(tmp_path):
    scan = scan_samples.nerfstudio(tmp_path)
    imported = posed(scan, tmp_path / "audit", length("frame_00001.png", "frame_00006.png")).poses
    with pytest.raises(
        AdvnerfError, match=r"expected no option that gives the metre, as .*import\.json has it from length"
    ):
        posed(imported, tmp_path / "other", length("frame_00001.png", "frame_00006.png"))


def test_a_folder_whose_import_never_began_is_free_for_another_place(tmp_path):
    ends, audit = ("frame_00001.png", "frame_00006.png"), tmp_path / "audit"
    (tmp_path / "empty").mkdir()
    with pytest.raises(AdvnerfError, match="expected photographs or a scan in it"):
        posed(tmp_path / "empty", audit, MetricOptions())
    assert posed(scan_samples.nerfstudio(tmp_path / "one"), audit, length(*ends)).scale == "length"


def test_an_audit_in_the_folder_of_its_place_is_no_change_of_the_place(tmp_path):
    scan, ends = scan_samples.nerfstudio(tmp_path), ("frame_00001.png", "frame_00006.png")
    there = posed(scan, scan / "audit", length(*ends))
    (scan / "audit" / "report.txt").write_text("what the audit has made since")
    assert posed(scan, scan / "audit", length(*ends)) == there


def test_the_photographs_of_another_place_or_metre_are_not_those_of_an_audit_s_folder(tmp_path):
    """Each import is repeated first, which takes what is there; then its place, its content or its metre changes."""
    ends, audit = ("frame_00001.png", "frame_00006.png"), tmp_path / "audit"
    one, other = scan_samples.nerfstudio(tmp_path / "one"), scan_samples.nerfstudio(tmp_path / "other")
    there = posed(one, audit, length(*ends))
    written = there.poses.read_bytes()
    assert posed(one, audit, length(*ends)) == there
    moved = one.rename(tmp_path / "moved")
    assert posed(moved, audit, length(*ends)) == there
    content = json.loads((other / "transforms.json").read_text())
    content["frames"] = content["frames"][:-1]
    (other / "transforms.json").write_text(json.dumps(content))
    with pytest.raises(AdvnerfError, match=r"where the photographs of .*moved were imported .* --output"):
        posed(other, audit, length(*ends))
    twice = MetricOptions(length=(*ends, 2.0 * length(*ends).length[2]))
    with pytest.raises(AdvnerfError, match="where another metre was given; name another one with --output"):
        posed(moved, audit, twice)
    assert there.poses.read_bytes() == written


def test_a_folder_of_nothing_names_what_is_taken(tmp_path):
    with pytest.raises(AdvnerfError, match=r"expected photographs or a scan in it .*poses_bounds\.npy"):
        posed(tmp_path, tmp_path / "audit", MetricOptions())
