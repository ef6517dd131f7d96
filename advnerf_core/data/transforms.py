"""``transforms.json`` from nerfstudio, Instant-NGP and blender, converted to our conventions on reading.

Files have OpenGL camera axes (x right, y up, z backward); everything after this module has OpenCV axes. Any error in
a file is one `DatasetError` that names the file, the frame and the field.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from advnerf_core.data.errors import DatasetError, raise_all
from advnerf_core.data.image_files import SUFFIXES, image_size
from advnerf_core.data.lens import Lens
from advnerf_core.data.posed_image import PosedImage
from advnerf_core.data.rigid import far_from_origin, rigid_pose
from advnerf_core.data.scan_folder import from_scan_advice
from advnerf_core.data.views import HELD_OUT_SPLITS, NGP_OFFSET, NGP_SCALE, TRAIN, PosedImages
from advnerf_core.documents import read_json
from advnerf_core.errors import ConfigError, MissingFileError
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Array, Pinhole, require_camera

_LENSES = {"OPENCV", "PINHOLE", "SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL", "PERSPECTIVE"}
_FISHEYES = {"OPENCV_FISHEYE", "FISHEYE", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
_LENS_KEYS = {
    "k1",
    "k2",
    "k3",
    "k4",
    "k5",
    "k6",
    "p1",
    "p2",
    "is_fisheye",
    "is_equirectangular",
    "equirectangular",
}
# Lens keys that other software reads; a reader that ignores one of these learns another camera.
_LENS_LIKE = re.compile(
    r"(k|p|s|b|d|sx|sy|ftheta_p)\d+|.*(distort|fisheye|shutter|skew|lens|latlong|equirect|orthographic|mitsuba).*",
    re.I,
)
# Keys that change what other software learns, but not the camera.
_OTHER_KEYS = (
    "white_transparent", "black_transparent", "mask_color", "fix_premult", "fisheye_crop_radius", "depth_file_path", "depth_path",
    "timestamp", "time",
)  # fmt: skip
# In the order in which they count where a file has several.
_FOCAL_FORMS = (("fl_x", "fl_y"), ("camera_angle_x", "camera_angle_y"), ("x_fov", "y_fov"))
# Two forms of one focal length differ by the digits that were written, and by an angle that was taken from a rounded image.
_SAME_LENS = 0.01
# No calibrated centre is so far from the middle [part of the side]; that of images at 3/4 of their size is 0.17 off.
_OFF_CENTRE = 0.15
_IN_PIXELS = ("fl_x", "fl_y", "cx", "cy")
_SPLITS = (TRAIN, *HELD_OUT_SPLITS)
_Values = dict[str, Any]


def load_transforms(path: str | Path, require_all: bool = False) -> PosedImages:
    """Read a ``transforms.json``, or a folder with one or with blender's ``transforms_train.json`` and similar files.

    Args:
        path: The file, or its folder.
        require_all: Whether a listed image that is missing is an error; otherwise it is left out and listed in ``missing``.

    Raises:
        DatasetError: Unreadable file, wrong content, or images missing.
    """
    files = _files(Path(path))
    sets = [_read_set(file, split, require_all) for file, split in files]
    first = sets[0]
    frames = tuple(frame for each in sets for frame in each.frames)
    missing = tuple(name for each in sets for name in each.missing)
    ignored = tuple(dict.fromkeys(key for each in sets for key in each.ignored))
    listed = PosedImages(frames, missing, first.aabb_scale, first.scale, first.offset, first.file, ignored)
    _refuse_far_away(listed)
    return listed


def _files(path: Path) -> list[tuple[Path, str | None]]:
    if not path.is_dir():
        return [(path, next((s for s in _SPLITS if path.stem == f"transforms_{s}"), None))]
    if not (path / "transforms.json").exists():
        split_files = [(path / f"transforms_{split}.json", split) for split in _SPLITS]
        if present := [(file, split) for file, split in split_files if file.exists()]:
            return list(present)
    return [(path / "transforms.json", None)]


def _read_set(path: Path, split: str | None, require_all: bool) -> PosedImages:
    content = _read_json(path)
    listed = content.get("frames")
    if not isinstance(listed, list) or not listed:
        raise DatasetError(f"expected a list 'frames' in {path}, got {type(listed).__name__} without entries")
    split_of, frames, missing = _listed_splits(path, content, listed), list[PosedImage](), list[Path]()
    wrong, reasons = list[DatasetError](), set[str]()
    number_of: dict[Path, int] = {}
    for number, entry in enumerate(listed):
        try:
            name = _name_of(entry)
            image = _image_path(path.parent, name)
            if image is None:
                missing.append(path.parent / name)
                continue
            if (first := number_of.setdefault(image, number)) != number:
                raise ValueError(
                    f"file_path: expected each image once, got that of frame {first} again; remove one of the two"
                )
            common = _without_other_focal_lengths(content, entry)
            _require_pixels_of_one_size(common, entry)
            values = {**common, **entry}
            frames.append(_frame(path.parent, image, values, split or split_of.get(_normal(name))))
        except ValueError as error:
            label = f" ({entry['file_path']})" if isinstance(entry, dict) and "file_path" in entry else ""
            wrong.append(DatasetError(f"{path}: frame {number}{label}: {error}"))
            reasons.add(str(error))
    if 1 < len(wrong) == len(listed) - len(missing) and len(reasons) == 1:  # a value of the whole file
        raise DatasetError(f"{path}: every frame: {reasons.pop()}")
    raise_all(wrong, len(listed), "frames")
    if missing and (require_all or not frames):
        raise DatasetError(
            f"expected {len(listed)} images listed in {path}, {len(missing)} are missing, the first is {missing[0]}; "
            "put the images there, or take the entries out of the file"
        )
    scale, offset, aabb = _ngp_box(path, content)
    entries = [content, *(entry for entry in listed if isinstance(entry, dict))]
    ignored = tuple(key for key in _OTHER_KEYS if any(_says_something(entry.get(key)) for entry in entries))
    return PosedImages(tuple(frames), tuple(missing), aabb, scale, offset, path, ignored)


def _read_json(path: Path) -> _Values:
    if path.suffix != ".json" and (advice := from_scan_advice(path, "")):
        raise DatasetError(f"expected a transforms.json, got {path}; {advice}")
    try:
        content = read_json(path)
    except MissingFileError as error:
        advice = from_scan_advice(path.parent, "correct the path")
        raise DatasetError(f"expected a transforms.json at {path}, found none; {advice}") from error
    except ConfigError as error:
        other = (
            ""
            if path.suffix == ".json"
            else f"expected a transforms.json or its folder, got {path}; it was read as one: "
        )
        raise DatasetError(f"{other}{error}") from error
    if not isinstance(content, dict):
        raise DatasetError(f"expected a JSON object in {path}, got {type(content).__name__}")
    return content


def _listed_splits(path: Path, content: _Values, listed: Sequence[Any]) -> dict[str, str]:
    """nerfstudio's lists of file names by split.

    Raises:
        DatasetError: A list is none, or no frame has any of its names: its images would be in no split.
    """
    splits: dict[str, str] = {}
    known = {_normal(str(entry.get("file_path"))) for entry in listed if isinstance(entry, dict)}
    for split in _SPLITS:
        names = content.get(f"{split}_filenames", [])
        if not isinstance(names, list):
            raise DatasetError(
                f"{path}: {split}_filenames: expected a list of files, got {type(names).__name__}"
            )
        if names and not any(_normal(str(name)) in known for name in names):
            raise DatasetError(
                f"{path}: {split}_filenames: expected names as the frames' file_path has them, got {len(names)} that no frame has, the first "
                f"is {names[0]!r:.80}; correct them, or remove the list"
            )
        splits.update({_normal(str(name)): split for name in names})
    return splits


def _ngp_box(path: Path, content: _Values) -> tuple[float, tuple[float, float, float], float | None]:
    try:
        scale = _number(content, "scale", NGP_SCALE, positive=True)
        aabb = (
            _number(content, "aabb_scale", 1.0, positive=True)
            if content.get("aabb_scale") is not None
            else None
        )
        raw = content.get("offset")
        given = NGP_OFFSET if raw is None else raw if isinstance(raw, list) else [raw] * 3
        if len(given) != 3:
            raise ValueError(f"offset: expected one number or three, got {len(given)}")
        x, y, z = (_number({"offset": value}, "offset", math.nan) for value in given)
    except ValueError as error:
        raise DatasetError(f"{path}: {error}") from error
    return scale, (x, y, z), aabb


def _name_of(entry: Any) -> str:
    if not isinstance(entry, dict):
        raise ValueError(
            f"expected an object with file_path and transform_matrix, got {type(entry).__name__}"
        )
    name = entry.get("file_path")
    if not isinstance(name, str) or not name:
        raise ValueError(f"file_path: expected the name of an image file, got {name!r}")
    return name.replace("\\", "/")  # written on Windows


def _normal(name: str) -> str:
    return Path(name.replace("\\", "/")).as_posix()


def _image_path(folder: Path, name: str) -> Path | None:
    # Blender's files omit the suffix.
    candidates: Iterable[Path] = (folder / name, *(folder / f"{name}{suffix}" for suffix in SUFFIXES))
    return next((c for c in candidates if c.is_file()), None)


def _frame(folder: Path, image: Path, values: _Values, split: str | None) -> PosedImage:
    mask = values.get("mask_path")
    mask_file = None if not mask else folder / str(mask).replace("\\", "/")
    if mask_file is not None and not mask_file.is_file():
        raise ValueError(
            f"mask_path: expected a mask at {mask_file}, it is missing; put it there or take the entry out"
        )
    return PosedImage(
        image,
        _pinhole(image, values),
        _lens(values),
        _pose(values),
        mask_file,
        str(values.get("camera_id", "")),
        split,
    )


def _pose(values: _Values) -> Array:
    if "transform_matrix" not in values:
        raise ValueError("transform_matrix: expected the camera's pose, it is missing")
    try:
        matrix = rigid_pose(values["transform_matrix"])
    except ValueError as error:
        raise ValueError(f"transform_matrix: {error}") from None
    return np.asarray(matrix @ OPENGL_FROM_OPENCV, np.float64)


def _refuse_far_away(listed: PosedImages) -> None:
    places = np.stack([frame.T_world_from_camera[:3, 3] for frame in listed.frames])
    if (wrong := far_from_origin(places)) is not None:
        farthest, problem = wrong
        name = listed.name_of(listed.frames[farthest])
        raise DatasetError(f"{listed.file}: frame {name}: transform_matrix: {problem}")


def _lens(values: _Values) -> Lens:
    is_fisheye = _flag(values, "is_fisheye")
    model = str(values.get("camera_model", "OPENCV_FISHEYE" if is_fisheye else "OPENCV"))
    panorama = next((key for key in ("is_equirectangular", "equirectangular") if _flag(values, key)), None)
    if panorama is not None or model not in _LENSES | _FISHEYES:
        got = model if panorama is None else f"{panorama} = true"
        raise ValueError(
            f"camera_model: expected {', '.join(sorted(_LENSES | _FISHEYES))}, got {got}; undistort the images first"
        )
    for key, value in values.items():
        if (
            _LENS_LIKE.fullmatch(key)
            and key not in _LENS_KEYS
            and key not in _OTHER_KEYS
            and _says_something(value)
        ):
            raise ValueError(
                f"{key}: expected a lens of {', '.join(sorted(_LENS_KEYS - {'k5', 'k6'}))} alone, got {key} = {value!r:.60}, which other "
                "software reads; undistort the images first, or take it out if they are ideal"
            )
    fisheye = model in _FISHEYES or is_fisheye
    keys = ("k1", "k2", "k3", "k4") if fisheye else ("k1", "k2", "p1", "p2", "k3")
    strange = ("p1", "p2") if fisheye else ("k4", "k5", "k6")
    for key in strange:
        if _number(values, key, 0.0) != 0.0:
            raise ValueError(
                f"{key}: expected only {', '.join(keys)} with camera_model {model}, got {values[key]}; undistort the images first"
            )
    return Lens(tuple(_number(values, key, 0.0) for key in keys), fisheye)


def _flag(values: _Values, key: str) -> bool:
    """A switch of the file; Python takes any text for true, also ``"false"``."""
    value = values.get(key)
    if value not in (None, False, True):  # 0 and 1 are these
        raise ValueError(f"{key}: expected true or false, got {value!r:.60}; write it without quotes")
    return bool(value)


def _says_something(value: Any) -> bool:
    """Whether a value is more than a zero, an empty text or a list of zeros."""
    if isinstance(value, list | tuple):
        return any(_says_something(each) for each in value)
    return value not in (None, False, 0, "", "none", "pinhole", "perspective", "PINHOLE", "PERSPECTIVE")


def _without_other_focal_lengths(content: _Values, entry: _Values) -> _Values:
    """The file's values without focal lengths in another form than the frame's, which would go before the frame's own.

    Raises:
        ValueError: The frame has the focal length of one axis, and the file that of the other, so of another lens: pixels would be stretched.
    """
    form = next((keys for keys in _FOCAL_FORMS if any(entry.get(key) is not None for key in keys)), None)
    if form is None:
        return content
    for own, other in (form, form[::-1]):
        if entry.get(other) is None and content.get(other) is not None:
            raise ValueError(
                f"{own}: expected {form[0]} and {form[1]} of one lens, got {own} = {entry[own]!r:.40} of the frame and {other} = "
                f"{content[other]!r:.40} of the file; give the frame {other} too, or take {other} out of the file"
            )
    others = {key for keys in _FOCAL_FORMS if keys != form for key in keys}
    return {key: value for key, value in content.items() if key not in others}


def _require_pixels_of_one_size(content: _Values, entry: _Values) -> None:
    """Raise for numbers of pixels from the file in a frame of another size, where they mean another camera."""
    for side in ("w", "h"):
        own, common = entry.get(side), content.get(side)
        taken = [key for key in _IN_PIXELS if entry.get(key) is None and content.get(key) is not None]
        if taken and own is not None and common is not None and own != common:
            raise ValueError(
                f"{side}: expected the size of the file, {common!r:.40}, as {', '.join(taken)} of the file are in its pixels, got {own!r:.40}; "
                f"give the frame its own {', '.join(taken)} too"
            )


def _pinhole(image: Path, values: _Values) -> Pinhole:
    given = [key for key in ("w", "h") if values.get(key) is not None]
    if len(given) == 2:
        width, height = (int(_number(values, key, 0.0, positive=True)) for key in given)
    elif given:
        raise ValueError(f"{given[0]}: expected both w and h, or neither, got {given[0]} alone")
    else:
        width, height = image_size(image)
    fx, fy = _focal_length(values, "x", width), _focal_length(values, "y", height)
    if fx is None and fy is None:
        raise ValueError("fl_x: expected fl_x, camera_angle_x or x_fov, none is there")
    centre = _number(values, "cx", 0.5 * width), _number(values, "cy", 0.5 * height)
    if not given:
        _require_centre_in_the_middle(centre, (width, height))
    return require_camera(Pinhole(width, height, fx or fy or 0.0, fy or fx or 0.0, *centre))


def _require_centre_in_the_middle(centre: tuple[float, float], size: tuple[int, int]) -> None:
    """Raise where a file that does not say the size of its pixels has a centre of smaller or larger images than these."""
    for key, value, side in zip(("cx", "cy"), centre, size, strict=True):
        if abs(value / side - 0.5) > _OFF_CENTRE:
            raise ValueError(
                f"{key}: expected a centre near the middle of the image of {size[0]} x {size[1]}, as the file has no w and h, got {value:g}; "
                "add w and h, the size that fl_x and cx are in pixels of"
            )


def _focal_length(values: _Values, axis: str, size: int) -> float | None:
    """Focal length of an axis [pixels], from the first form that is there.

    Raises:
        ValueError: It is no number, or another form says another one: it is in pixels of another size, or of another lens.
    """
    keys = [form["xy".index(axis)] for form in _FOCAL_FORMS]
    said = {key: _focal_length_of(values, key, size) for key in keys if values.get(key) is not None}
    first = next(iter(said), "")
    for key, focal in said.items():
        if not math.isclose(focal, said[first], rel_tol=_SAME_LENS):
            raise ValueError(
                f"{first}: expected the lens that {key} = {values[key]!r:.40} says, {focal:.6g} pixels in an image of {size}, got "
                f"{values[first]!r:.40}; correct w and h if they are not of these images, or take the wrong one out"
            )
    return said.get(first)


def _focal_length_of(values: _Values, key: str, size: int) -> float:
    value = _number(values, key, 0.0, positive=True)
    if key in ("fl_x", "fl_y"):
        return value
    angle = math.radians(value) if key.endswith("_fov") else value
    if angle >= math.pi:
        raise ValueError(f"{key}: expected a field of view below a half turn, got {values[key]}")
    if key.endswith("_fov") and value < math.pi:  # no lens that poses were found for is so long
        raise ValueError(
            f"{key}: expected a field of view in degrees, got {values[key]}; if it is in radians, write it as camera_angle_{key[0]}"
        )
    return 0.5 * size / math.tan(0.5 * angle)


def _number(values: _Values, key: str, default: float, positive: bool = False) -> float:
    raw = values.get(key)
    try:
        if isinstance(raw, bool):  # a number in Python
            raise TypeError
        value = default if raw is None else float(raw)
    except (TypeError, ValueError):
        raise ValueError(f"{key}: expected a number, got {raw!r:.60}") from None
    if not math.isfinite(value) or (positive and value <= 0.0):
        raise ValueError(f"{key}: expected a {'positive' if positive else 'finite'} number, got {raw}")
    return value
