"""Whether the picture of a set agrees with its drives: it is drawn again. Needs matplotlib."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image, UnidentifiedImageError

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.hardness import titles_of
from advnerf_core.report.evidence.page import picture_of
from advnerf_core.report.evidence.results import Evidence, read_evidence
from advnerf_core.report.evidence.verifying.layout import SET

DPI = 110
# Another version of matplotlib or of its fonts moves letters by a pixel; a moved point or bar is darker.
_BLOCK_PX, _LARGEST = 8, 24.0


def write_picture(evidence: Evidence, folder: Path, into: Path) -> Path:
    """Draw the picture of a set into a folder, such as the folder of all sets."""
    from advnerf_core.report.evidence.plot import excess_plot  # loads matplotlib
    from advnerf_core.report.plots import write_png

    return write_png(
        excess_plot(evidence, titles_of(folder, read_json(folder / SET))),
        into / picture_of(folder.name),
        dpi=DPI,
    )


def picture_problems(folder: Path) -> Iterator[str]:
    """Whether the picture beside a set agrees with its drives, up to another machine's letters."""
    file = folder.parent / picture_of(folder.name)
    try:
        published = _pixels(file)
    except (OSError, UnidentifiedImageError) as error:
        yield f"{file}: cannot be read: {error}"
        return
    with TemporaryDirectory() as work:
        drawn = _pixels(write_picture(read_evidence(folder), folder, Path(work)))
    if published.shape != drawn.shape:
        yield f"{file}: expected {drawn.shape[1]} x {drawn.shape[0]} pixels as its drives give, got {published.shape[1]} x {published.shape[0]}"
    elif (largest := float(np.abs(_blocks(published) - _blocks(drawn)).max())) > _LARGEST:
        yield f"{file}: shows something else than its drives, by {largest:.0f} of 255 somewhere"


def _pixels(file: Path) -> NDArray[np.float64]:
    with Image.open(file) as picture:
        return np.asarray(picture.convert("L"), np.float64)


def _blocks(pixels: NDArray[np.float64]) -> NDArray[np.float64]:
    """Means of square blocks, which hardly change if a letter moves by a pixel."""
    rows, columns = (length // _BLOCK_PX for length in pixels.shape)
    whole = pixels[: rows * _BLOCK_PX, : columns * _BLOCK_PX]
    return np.asarray(whole.reshape(rows, _BLOCK_PX, columns, _BLOCK_PX).mean((1, 3)))
