"""Files of logs, one of which is damaged at a time."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

from advnerf_core.data.logs.choice import LogChoice
from nodes.lab.policy_data.logs import open_log
from tests.support import logs

_ANSWERS = LogChoice(steering_full_rad=0.4, steering_positive="left")
_OF_A_KIND = 2


class LogFiles:
    """One sample of each format; an input is the number of a file and its content.

    Args:
        folder: Folder for the samples.
    """

    def __init__(self, folder: Path) -> None:
        samples = [logs.write_tub_2(folder / "tub2"), logs.write_tub_1(folder / "tub1", excluded=(4,))]
        samples += [logs.write_udacity(folder / "udacity", True, "IMG/")]
        if find_spec("pyarrow") and find_spec("av"):
            samples += [logs.write_lerobot_2(folder / "lerobot2"), logs.write_lerobot_3(folder / "lerobot3")]
            samples += [logs.write_lerobot_3(folder / "images", images="image")]
        self._files = [(sample, file) for sample in samples for file in self._some(sample)]
        self.good = [bytes([number]) + file.read_bytes() for number, (_, file) in enumerate(self._files)]

    @staticmethod
    def _some(sample: Path) -> list[Path]:
        """A few files of each suffix."""
        files = sorted(file for file in sample.rglob("*") if file.is_file())
        of_suffix = {
            suffix: [file for file in files if file.suffix == suffix]
            for suffix in {file.suffix for file in files}
        }
        return sorted(file for each in of_suffix.values() for file in each[:_OF_A_KIND])

    def read(self, data: bytes) -> None:
        """Read the log of an input whose file has this content."""
        number = data[0] % len(self._files) if data else 0
        sample, file = self._files[number]
        file.write_bytes(data[1:])
        try:
            log = open_log(sample, _ANSWERS)
            log.steering()
            for _ in log.frames():
                pass
        finally:
            file.write_bytes(self.good[number][1:])
