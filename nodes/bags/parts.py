"""Finds the files of a bag in order: one file, or the numbered parts of a split bag.

A recorder names its parts ``NAME_0.mcap``, ``NAME_1.mcap`` ... in a folder ``NAME``, as rosbag2 does, and lists them in
``metadata.yaml``. The folder, its ``metadata.yaml`` and each part all stand for the whole bag.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path, PurePosixPath

from advnerf_core.documents import read_yaml
from nodes.runtime.errors import BagError

METADATA_FILE = "metadata.yaml"
SUFFIXES = (".mcap", ".db3", ".bag")
_NUMBERED = re.compile(r"(?P<name>.+)_(?P<number>\d{1,9})")
# 83 parts take 15 kB. A foreign file may have any size.
_MOST_METADATA_BYTES = 1 << 24


def part_name(bag_name: str, number: int) -> str:
    """File name of a part. Numbers start at 0."""
    return f"{bag_name}_{number}.mcap"


def holds_bag(folder: Path) -> bool:
    """Whether a folder contains the files of a bag."""
    return bool(_files(Path(folder)))


def is_bag_file(file: Path) -> bool:
    """Whether a file stands for a bag by its name."""
    return file.suffix.lower() in SUFFIXES or file.name == METADATA_FILE


def bag_parts(bag: Path) -> tuple[Path, ...]:
    """Return the files of a bag in the order of their recording.

    ``metadata.yaml`` gives the order. Parts with higher numbers that it does not list yet, because the recorder was killed or is still
    running, follow. Without it, the parts are sorted by number.

    Args:
        bag: Bag folder, its ``metadata.yaml``, or any of its files. A file belongs to its folder's bag if ``metadata.yaml`` lists it
            or the folder has the name of the bag. Otherwise it is a separate bag.

    Raises:
        BagError: The bag does not exist, a part is missing, or the files of the folder are not parts of one bag.
    """
    bag = Path(bag)
    if bag.name == METADATA_FILE and bag.is_file():
        bag = bag.parent
    if bag.is_file():
        return _parts_with(bag)
    files = _files(bag)
    if listed := listed_files(bag):
        return _with_unlisted(bag, listed)
    if not files:
        raise _no_bag(bag)
    if len(files) == 1 and not _is_named_after_folder(files[0]):
        return (files[0],)
    return _by_number(bag, files)


def unread_files(bag: Path) -> str:
    """Which bag files in a bag's folder are not its parts, as of another recording that was copied there; empty if there are none."""
    if not Path(bag).is_dir():
        return ""
    parts = bag_parts(bag)
    files = [file for suffix in SUFFIXES for file in _of_suffix(Path(bag), suffix)]
    unread = [file.name for file in files if file not in parts]
    return (
        f"not read, as no part of this bag: {', '.join(unread)}; give each of these files by itself"
        if unread
        else ""
    )


def _parts_with(file: Path) -> tuple[Path, ...]:
    """All parts of the bag to which a file belongs."""
    if listed := listed_files(file.parent):
        parts = _with_unlisted(file.parent, listed)
        return parts if file in parts else (file,)
    if not _is_named_after_folder(file):
        return (file,)
    name = file.absolute().parent.name
    numbered = [
        each for each in _files(file.parent) if _numbered(each)[0] == name and each.suffix == file.suffix
    ]
    return _by_number(file.parent, numbered)


def _files(folder: Path) -> list[Path]:
    """Bag files in a folder, of the first suffix that occurs."""
    if not folder.is_dir():
        return []
    return next((files for suffix in SUFFIXES if (files := _of_suffix(folder, suffix))), [])


def _of_suffix(folder: Path, suffix: str) -> list[Path]:
    return sorted(
        file for file in folder.glob(f"*{suffix}") if not file.name.startswith(".") and file.is_file()
    )


def _numbered(file: Path) -> tuple[str, int]:
    """Name of the bag and number of the part; -1 for a file without a number."""
    match = _NUMBERED.fullmatch(file.stem)
    return (match["name"], int(match["number"])) if match else (file.stem, -1)


def _is_named_after_folder(file: Path) -> bool:
    name, number = _numbered(file)
    return number >= 0 and name == file.absolute().parent.name


def listed_files(folder: Path) -> tuple[str, ...]:
    """File names listed in a folder's ``metadata.yaml``, in order; none without such a file."""
    path = folder / METADATA_FILE
    try:
        state = path.stat()
    except OSError:
        return ()
    return _names_in(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=16)
def _names_in(path: Path, mtime_ns: int, size_bytes: int) -> tuple[str, ...]:
    del mtime_ns
    advice = "remove it to read the parts by their numbers"
    try:
        if size_bytes > _MOST_METADATA_BYTES:
            raise BagError(
                f"{path}: expected at most {_MOST_METADATA_BYTES >> 20} MiB, got {size_bytes} bytes; {advice}"
            )
        information = read_yaml(path).data["rosbag2_bagfile_information"]
        # Old versions of rosbag2 wrote the folder before the name.
        names = tuple(PurePosixPath(name).name for name in information["relative_file_paths"])
    except (OSError, ValueError, TypeError, KeyError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{path}: expected the metadata of a rosbag2 bag, got an unreadable file ({said:.120}); {advice}"
        ) from error
    if not all(names):
        raise BagError(
            f"{path}: expected names of files under relative_file_paths, got an empty one; {advice}"
        )
    return names


def _with_unlisted(folder: Path, listed: tuple[str, ...]) -> tuple[Path, ...]:
    """The listed parts, followed by parts with higher numbers."""
    for name in listed:
        if not (folder / name).is_file():
            raise _missing(folder, name, f"but {METADATA_FILE} lists it")
    parts = [folder / name for name in listed]
    bag_name, last = _numbered(parts[-1])
    if last < 0:
        return tuple(parts)
    later = {
        number: file for file in _files(folder) for name, number in [_numbered(file)] if name == bag_name
    }
    for number in range(last + 1, max(later, default=last) + 1):
        if number not in later:
            raise _missing(folder, f"{bag_name}_{number}{parts[-1].suffix}", "but a later one exists")
        parts.append(later[number])
    return tuple(parts)


def _by_number(folder: Path, files: list[Path]) -> tuple[Path, ...]:
    found = {number: file for file in files for _, number in [_numbered(file)]}
    names = {_numbered(file)[0] for file in files}
    if len(names) > 1 or -1 in found:
        said = ", ".join(file.name for file in files[:4]) + (", ..." if len(files) > 4 else "")
        raise BagError(
            f"{folder}: expected a bag folder with one .mcap file or with the parts NAME_0.mcap, NAME_1.mcap ..., got {len(files)}: "
            f"{said}; give one of the files"
        )
    (name,) = names
    for number in range(max(found) + 1):
        if number not in found:
            raise _missing(folder, f"{name}_{number}{files[0].suffix}", "but a later one exists")
    return tuple(found[number] for number in range(max(found) + 1))


def _no_bag(folder: Path) -> BagError:
    """Error about a folder without a bag, or a missing folder."""
    expected = (
        f"expected a bag folder with {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} files, or one such file"
    )
    if not folder.is_dir():
        return BagError(f"{folder} does not exist; {expected}")
    names = sorted(file.name + ("/" if file.is_dir() else "") for file in folder.iterdir())
    said = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    return BagError(f"{folder} is a folder without a bag: it has {said or 'no files'}; {expected}")


def _missing(folder: Path, name: str, reason: str) -> BagError:
    return BagError(
        f"{folder}: the part {name} of the bag is missing, {reason}; restore it, or copy the other parts to a folder with another "
        "name and read them one by one"
    )
