"""Writes a folder of posed images, picture by picture."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from advnerf_core.data.image_files import write_image
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.geometry import Array, Pinhole


def write_posed_images(
    folder: Path,
    poses: Sequence[Array],
    pinhole: Pinhole | Sequence[Pinhole],
    see: Callable[[int], NDArray[np.uint8]],
    suffix: Literal["jpg", "png"],
    *,
    keep: bool = False,
    valid: Sequence[Callable[[], NDArray[np.bool_]] | None] = (),
    told: Callable[[int], None] = lambda count: None,
) -> int:
    """Write ``images/00000.<suffix>`` and so on and, when all exist, their ``transforms.json``; without poses, no files.

    Args:
        poses: ``T_world_from_camera [4, 4]`` of each picture, OpenCV axes.
        pinhole: Intrinsics of all, or of each.
        see: Takes the picture ``[h, w, 3]`` of an index.
        suffix: ``png`` where pixels are compared, ``jpg`` where a scene is learned from them.
        keep: Skip existing pictures, to resume a capture. The caller must make sure that they belong to these poses.
        valid: For each picture, what reads which pixels ``[h, w]`` count, or None where all do; stored as masks. None for all if it is empty.
        told: Progress callback, called after each picture with the number of existing ones.

    Returns:
        Number of pictures taken in this call.
    """
    names = [f"images/{index:05d}.{suffix}" for index in range(len(poses))]
    masks: list[str | None] = [None] * len(names)
    taken = 0
    for index, name in enumerate(names):
        if not (keep and (folder / name).exists()):
            write_image(folder / name, see(index))
            taken += 1
        if valid and (read := valid[index]) is not None:
            masks[index] = mask = f"masks/{index:05d}.png"
            write_image(folder / mask, np.dstack([np.where(read(), np.uint8(255), np.uint8(0))] * 3))
        told(index + 1)
    if names:
        write_transforms(folder / "transforms.json", names, np.stack(poses), pinhole, masks=masks)
    return taken
