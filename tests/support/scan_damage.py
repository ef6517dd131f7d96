"""Files of scans, one of which is damaged at a time."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from calibration.scans.reading import read_scan
from calibration.scans.scan import ScanOptions
from tests.support import colmap_models, scan_samples

# Of each format, everything but images.
_PATTERNS = ("*.json", "*.r3d", "metadata", "*.npy", "*.csv", "*.yaml", "*.txt", "*.ply")
_OF_A_KIND = 3


class ScanFiles:
    """One sample of each format; an input is the number of a file and its content.

    Args:
        folder: Folder for the samples.
    """

    def __init__(self, folder: Path) -> None:
        self._files: list[tuple[Path, Path]] = []
        for kind in scan_samples.KINDS:
            scan = scan_samples.write(kind, folder / kind)
            self._files += [(scan, file) for file in self._own(scan)]
        for text in (False, True) if find_spec("pycolmap") else ():
            project, model = folder / f"COLMAP{text}", colmap_models.synthetic(4)
            colmap_models.write_images(project / "images", colmap_models.poses_by_name(model))
            files = colmap_models.write(model, project / "sparse" / "0", text).iterdir()
            self._files += [(project, file) for file in sorted(files)]
        self.good = [bytes([number]) + file.read_bytes() for number, (_, file) in enumerate(self._files)]

    @staticmethod
    def _own(scan: Path) -> list[Path]:
        if scan.is_file():
            return [scan]
        found = [sorted(scan.rglob(pattern)) for pattern in _PATTERNS]
        return [file for files in found for file in files[:_OF_A_KIND]]

    def read(self, data: bytes) -> None:
        """Read the scan of an input whose file has this content."""
        number = data[0] % len(self._files) if data else 0
        scan, file = self._files[number]
        file.write_bytes(data[1:])
        try:
            read_scan(scan, ScanOptions())
        finally:
            file.write_bytes(self.good[number][1:])
