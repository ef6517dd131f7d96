"""Reads any scan: recognises its format and calls its reader."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from advnerf_core.data.scan_folder import SCANS, scan_of
from calibration.scans import colmap, euroc, llff, nerfstudio, polycam, record3d, tum
from calibration.scans.scan import Scan, ScanError, ScanOptions

READERS: dict[str, Callable[[Path, ScanOptions], Scan]] = {
    "Polycam": polycam.read,
    "Record3D": record3d.read,
    "EuRoC": euroc.read,
    "nerfstudio": nerfstudio.read,
    "COLMAP": colmap.read,
    "LLFF": llff.read,
    "TUM": tum.read,
}
_SHOWN = 6


def read_scan(path: Path, options: ScanOptions) -> tuple[str, Scan]:
    """Read a scan; the name of its format, and its content.

    Raises:
        ScanError: The format is unknown, or the scan cannot be used.
        AdvnerfError: A file of it cannot be read.
    """
    found = scan_of(path)
    if found is None:
        known = "; ".join(f"{each.name} ({each.shown_by})" for each in SCANS)
        raise ScanError(
            f"{path}: expected a scan of one of the formats {known}, got {_shown(path)}; give the folder that holds these files, or photographs and videos to advnerf scene from-images and from-video"
        )
    return found.name, READERS[found.name](path, options)


def _shown(path: Path) -> str:
    if not path.is_dir():
        return "a file" if path.exists() else "nothing"
    there = sorted(each.name for each in path.iterdir())
    return ", ".join(there[:_SHOWN]) + (", ..." if len(there) > _SHOWN else "") or "an empty folder"
