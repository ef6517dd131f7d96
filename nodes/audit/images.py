"""The posed photographs of a place, from the user's input: ``transforms.json``, any other scan, photographs, or videos."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.data.image_files import HEIF_SUFFIXES, SUFFIXES
from advnerf_core.data.scan_folder import DATA_SET, SCANS, ScanFolder, scan_of
from advnerf_core.documents import read_json
from advnerf_core.report.audit_parts import PlaceKind, Scale
from nodes.audit.asking import UnansweredError
from nodes.lab.importing.metric_options import MetricOptions
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay

POSES, IMPORTED, REPORT = "transforms.json", "photos", "import.json"
# nerfstudio writes this key for poses from structure from motion, whose unit is arbitrary.
_OF_COLMAP = "applied_transform"
_SPLATS = (".ply", ".spz", ".splat", ".glb")
_EXTENT_M = 1.0  # of a set without a known metre, which is then rejected
_MOVEMENT, _MOST = 0.06, 300  # as in ``advnerf scene from-video``


@dataclass(frozen=True)
class PosedPlace:
    """The ``transforms.json`` of photographs with poses, and whether the ground is known to be at z = 0."""

    poses: Path
    kind: PlaceKind
    scale: Scale
    ground_at_zero: bool


def posed(given: Path, folder: Path, metric: MetricOptions) -> PosedPlace:
    """The posed photographs of a place; input without poses is imported into the audit's folder, once.

    Raises:
        ConfigError: The input is of no known kind.
        UnansweredError: The length of a metre is unknown.
        AdvnerfError: The input cannot be read, or poses cannot be estimated.
    """
    poses = given / POSES if given.is_dir() else given
    found = scan_of(given)
    if found is not None and found.name == DATA_SET and poses.is_file():
        ours = bool(_facts(poses.parent))
        if not metric.gives_metre or (ours and _scale_of(poses) is not None):
            return _known(poses, "images")
    imported = folder / IMPORTED
    kind: PlaceKind = "images" if given.is_dir() or found is not None else "video"
    if not (imported / POSES).is_file() or (metric.gives_metre and _scale_of(imported / POSES) is None):
        with ProgressDisplay() as display:
            _import(given, found, imported, metric, display)
    return _known(imported / POSES, kind)


def _known(poses: Path, kind: PlaceKind) -> PosedPlace:
    scale = _scale_of(poses)
    if scale is None:
        raise UnansweredError(
            f"expected a known length, as {poses} has none and an audit speaks of metres: --length A B METRES (A and B: two of the images there, "
            "METRES: between their cameras), --positions CSV or --marker SIDE"
        )
    return PosedPlace(poses, kind, scale, bool(_facts(poses.parent).get("ground_at_zero", False)))


def _scale_of(poses: Path) -> Scale | None:
    facts = _facts(poses.parent)
    content = {} if facts else read_json(poses)
    if isinstance(content, dict) and _OF_COLMAP in content:
        return None
    scale: Scale | None = facts.get("scale_from", "poses")
    return scale


def _facts(folder: Path) -> dict[str, Any]:
    """The report of an import; empty without one."""
    facts: dict[str, Any] = read_json(folder / REPORT) if (folder / REPORT).is_file() else {}
    return facts


def _import(
    given: Path, found: ScanFolder | None, output: Path, metric: MetricOptions, display: ProgressDisplay
) -> None:
    """Make a data set of some input."""
    if found is not None:
        from calibration.scans.scan import ScanOptions
        from nodes.lab.importing.scan import from_scan

        from_scan(given, output, ScanOptions(), metric, display.start("poses"))
        return
    if not given.exists():
        raise ConfigError(
            f"--place: expected photographs, a video or a scan, got {given}, which is not there"
        )
    if given.suffix == ".safetensors":
        raise ConfigError(
            f"--place {given}: expected the images that this scene was learned from, as a learned scene alone cannot be compared with its place; to "
            "search in it without a verdict, see world: {kind: scene} in docs/experiments.md"
        )
    if given.suffix.lower() in _SPLATS:
        raise ConfigError(
            f"--place {given}: expected the images that this splat was trained on, as a splat alone cannot be compared with its place; 'advnerf scene "
            "from-splat' makes a scene of it, to search in without a verdict: world: {kind: scene} in docs/experiments.md"
        )
    if given.is_dir() and not any(
        each.suffix.lower() in (*SUFFIXES, *HEIF_SUFFIXES) for each in given.rglob("*")
    ):
        known = ", ".join(each.shown_by for each in SCANS)
        raise ConfigError(
            f"--place {given}: expected photographs or a scan in it ({known}), got a folder without; give the folder that holds them"
        )
    _from_media(given, output, metric, display)


def _from_media(given: Path, output: Path, metric: MetricOptions, display: ProgressDisplay) -> None:
    from advnerf_core.data.keyframes import KeyframeConfig
    from calibration.photo_model import SfmConfig
    from nodes.lab.importing.data_set import from_media
    from nodes.lab.importing.media import MediaConfig

    config = MediaConfig(KeyframeConfig(_MOVEMENT), _MOST, False)
    from_media([given], output, config, SfmConfig(seed=0), _EXTENT_M, metric, display.start("poses"))
