"""Posed images on disk and in memory: the one door by which photographs come in.

Files have OpenGL camera axes and possibly lens distortion, masks and transparency (see `transforms`); everything after this
door has OpenCV axes and ideal pinholes with pixel centres at +0.5 (see `views` and `lens`).
"""

from __future__ import annotations

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.data.view_loading import LoadedView, load_image, load_view
from advnerf_core.data.views import ImageSet, PosedImages

__all__ = [
    "DatasetError",
    "ImageSet",
    "Lens",
    "LoadedView",
    "PosedImage",
    "PosedImages",
    "load_image",
    "load_transforms",
    "load_view",
    "write_transforms",
]  # fmt: skip
