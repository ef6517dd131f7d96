"""Recognises folders of COLMAP, so that an error can name the command that reads them."""

from __future__ import annotations

from pathlib import Path

_FILES = ("cameras", "images", "points3D")


def model_suffix(folder: Path) -> str | None:
    """``.bin`` or ``.txt`` for a COLMAP model, binary first as in COLMAP; None if the folder has none."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in _FILES):
            return suffix
    return None


def from_colmap_advice(folder: Path, otherwise: str) -> str:
    """Advice for an error about a folder without the expected files: the import from COLMAP if it holds a model.

    Args:
        folder: A COLMAP project, a folder of models, or a model.
        otherwise: The advice if it holds no model.
    """
    for models in (folder, folder / "sparse", folder / "colmap" / "sparse"):
        inside = models.iterdir() if models.is_dir() else ()
        if model_suffix(models) or any(model_suffix(each) for each in inside):
            images = folder / "images"
            return f"it holds a COLMAP model, so run: advnerf scene from-colmap {models} {images if images.is_dir() else 'IMAGES'} -o NEW_FOLDER"
    return otherwise
