"""The posed photographs of a place, from the user's input: ``transforms.json``, any other scan, photographs, or videos."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from advnerf_core.data.image_files import HEIF_SUFFIXES, SUFFIXES
from advnerf_core.data.scan_folder import DATA_SET, SCANS, ScanFolder, scan_of
from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.report.audit_result import PlaceKind, Scale
from nodes.audit.asking import UnansweredError
from nodes.experiment.engine.artefact import hash_of
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.staging import work_folder
from nodes.lab.located import content_sha256
from nodes.runtime.errors import ConfigError
from nodes.runtime.progress import ProgressDisplay

POSES, IMPORTED, REPORT, INPUT = "transforms.json", "photos", "import.json", "imported_from.json"
_SPLATS = (".ply", ".spz", ".splat", ".glb")
_EXTENT_M = 1.0  # of a set without a known metre, which is then rejected


@dataclass(frozen=True)
class PosedPlace:
    """The ``transforms.json`` of photographs with poses, and whether the ground is known to be at z = 0."""

    poses: Path
    kind: PlaceKind
    scale: Scale
    ground_at_zero: bool


def posed(given: Path, folder: Path, metric: MetricOptions, in_metres: bool = False) -> PosedPlace:
    """The posed photographs of a place; input without poses, or without metres, is imported into the audit's folder, once.

    Args:
        given: Folder or file of the place.
        folder: Folder of the audit.
        metric: The options that give the metre.
        in_metres: Whether the poses of posed photographs are in metres already.

    Raises:
        ConfigError: The input is of no known kind, the folder has photographs of another one, or an option about the metre is not needed.
        UnansweredError: The length of a metre is unknown.
        AdvnerfError: The input cannot be read, or poses cannot be estimated.
    """
    poses = given / POSES if given.is_dir() else given
    found = scan_of(given)
    if found is not None and found.name == DATA_SET and poses.is_file():
        known = _scale_of(poses)
        if known is not None and (metric.gives_metre or in_metres):
            raise ConfigError(
                f"expected no option that gives the metre, as {poses.parent / REPORT} has it from {known}; leave it out, or import the place anew"
            )
        if in_metres and metric.gives_metre:
            raise ConfigError(
                "expected one source of the metre, got --in-metres and another; give one of them"
            )
        if known is not None or in_metres or not metric.gives_metre:
            return _known(poses, "images", known or ("poses" if in_metres else None))
    elif in_metres:
        raise ConfigError(f"--in-metres: expected photographs with poses ({POSES}), got {given}")
    imported = folder / IMPORTED
    kind: PlaceKind = "images" if given.is_dir() or found is not None else "video"
    there = _scale_of(imported / POSES)
    _require_same_input(folder, given, metric, has_metre=there is not None)
    if not (imported / POSES).is_file() or (metric.gives_metre and there is None):
        with ProgressDisplay() as display:
            _import(given, found, imported, metric, display)
    return _known(imported / POSES, kind, _scale_of(imported / POSES))


def _known(poses: Path, kind: PlaceKind, scale: Scale | None) -> PosedPlace:
    if scale is None:
        raise UnansweredError(
            f"expected a known length, as {poses} has none and an audit speaks of metres: --length A B METRES (A and B: two of the images there, "
            "METRES: between their cameras), --positions CSV or --marker SIDE; --in-metres if posed photographs are in metres already"
        )
    return PosedPlace(poses, kind, scale, bool(_facts(poses.parent).get("ground_at_zero", False)))


def _scale_of(poses: Path) -> Scale | None:
    """What gave the metre of an import; None if nothing did, or for poses of other software, whose unit no file states."""
    scale: Scale | None = facts.get("scale_from", "poses") if (facts := _facts(poses.parent)) else None
    return scale


def _require_same_input(folder: Path, given: Path, metric: MetricOptions, has_metre: bool) -> None:
    """Write down what is imported into an audit's folder, or check that it is what was imported there before, wholly or in part.

    Raises:
        ConfigError: It is another place, or another metre.
    """
    file = folder / INPUT
    said = {name: str(value) for name, value in asdict(metric).items()}
    now = {"given": str(given.resolve()), "content": _digest(given, folder), "metric": said}
    imported = folder / IMPORTED
    begun = (imported / POSES).is_file() or work_folder(imported).exists()
    before = read_json(file) if begun and file.is_file() else now
    changed = [key for key in now if before.get(key) != now[key]]
    if "given" in changed and "content" not in changed:  # the files were moved
        changed.remove("given")
    if changed and (changed != ["metric"] or has_metre):
        what = (
            "another metre was given"
            if changed == ["metric"]
            else f"the photographs of {before['given']} were imported as they then were"
        )
        raise ConfigError(
            f"expected a folder of this audit or a new one, got {folder}, where {what}; name another one with --output"
        )
    write_json(file, now)


def _digest(given: Path, made: Path) -> str:
    """Hash of a file, or of all files of a folder with their names.

    Args:
        made: Folder of the audit, which may lie in the folder of the place, and does not belong to it.
    """
    if not given.is_dir():
        return content_sha256(given) if given.is_file() else ""
    own = made.resolve()
    files = [
        each for each in sorted(given.rglob("*")) if each.is_file() and not each.resolve().is_relative_to(own)
    ]
    return hash_of([(str(each.relative_to(given)), content_sha256(each)) for each in files])


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
    from calibration.photo_model import SfmConfig
    from nodes.lab.importing.data_set import from_media
    from nodes.lab.importing.media import MediaConfig

    from_media([given], output, MediaConfig(), SfmConfig(seed=0), _EXTENT_M, metric, display.start("poses"))
