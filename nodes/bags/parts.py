"""The files of a bag, in order: one, or the numbered parts into which a recorder split it.

A recorder names its parts ``NAME_0.mcap``, ``NAME_1.mcap`` ... in a folder ``NAME``, as rosbag2 does, and ``metadata.yaml`` lists
them. A bag is given as its folder, as its ``metadata.yaml``, or as any of its parts: all three mean the whole bag.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path, PurePosixPath

import yaml

from nodes.runtime.errors import BagError

METADATA_FILE = "metadata.yaml"
SUFFIXES = (".mcap", ".db3", ".bag")
_NUMBERED = re.compile(r"(?P<name>.+)_(?P<number>\d{1,9})")
# 83 parts take 15 kB; a stranger's file may have any size.
_MOST_METADATA_BYTES = 1 << 24
_SafeLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


def part_name(bag_name: str, number: int) -> str:
    """File name of a part, counted from 0."""
    return f"{bag_name}_{number}.mcap"


def holds_bag(folder: Path) -> bool:
    """Whether a folder has the files of a bag in it."""
    return bool(_files(Path(folder)))


def bag_parts(bag: Path) -> tuple[Path, ...]:
    """The files of a bag in the order in which they were recorded.

    ``metadata.yaml`` gives the order; parts with higher numbers that it does not list yet (their recorder was killed, or is at work)
    follow. Without it, parts are taken by number.

    Args:
        bag: Bag folder, its ``metadata.yaml``, or any of its files. A file is a part of its folder's bag if ``metadata.yaml`` lists
            it or the folder has the bag's name; otherwise it is a bag by itself.

    Raises:
        BagError: There is no bag, a part is missing, or the files of the folder are no parts of one bag.
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


def _parts_with(file: Path) -> tuple[Path, ...]:
    """All parts of the bag that a file belongs to."""
    if listed := listed_files(file.parent):
        parts = _with_unlisted(file.parent, listed)
        return parts if file in parts else (file,)
    if not _is_named_after_folder(file):
        return (file,)
    name = file.absolute().parent.name
    numbered = [each for each in _files(file.parent) if _numbered(each)[0] == name and each.suffix == file.suffix]
    return _by_number(file.parent, numbered)


def _files(folder: Path) -> list[Path]:
    """Recordings in a folder, of the first suffix that occurs."""
    if not folder.is_dir():
        return []
    for suffix in SUFFIXES:
        files = sorted(file for file in folder.glob(f"*{suffix}") if not file.name.startswith(".") and file.is_file())
        if files:
            return files
    return []


def _numbered(file: Path) -> tuple[str, int]:
    """Name of the bag and number of the part; -1 for a file without a number."""
    match = _NUMBERED.fullmatch(file.stem)
    return (match["name"], int(match["number"])) if match else (file.stem, -1)


def _is_named_after_folder(file: Path) -> bool:
    name, number = _numbered(file)
    return number >= 0 and name == file.absolute().parent.name


def listed_files(folder: Path) -> tuple[str, ...]:
    """File names in a folder's ``metadata.yaml`` in order; none if there is no such file."""
    path = folder / METADATA_FILE
    try:
        state = path.stat()
    except OSError:
        return ()
    return _names_in(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=16)
def _names_in(path: Path, mtime_ns: int, size_bytes: int) -> tuple[str, ...]:
    del mtime_ns
    advice = "remove it, and the parts are taken by their numbers"
    try:
        if size_bytes > _MOST_METADATA_BYTES:
            raise BagError(
                f"{path}: expected at most {_MOST_METADATA_BYTES >> 20} MiB, got {size_bytes} bytes; {advice}"
            )
        content = yaml.load(path.read_bytes(), Loader=_SafeLoader)
        information = content["rosbag2_bagfile_information"]
        # Old versions of rosbag2 wrote the folder in front of the name.
        names = tuple(PurePosixPath(name).name for name in information["relative_file_paths"])
    except (OSError, yaml.YAMLError, ValueError, TypeError, KeyError, RecursionError) as error:
        said = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{path}: expected the metadata of a rosbag2 bag, cannot read it ({said:.120}); {advice}"
        ) from error
    if not all(names):
        raise BagError(f"{path}: expected names of files under relative_file_paths, got an empty one; {advice}")
    return names


def _with_unlisted(folder: Path, listed: tuple[str, ...]) -> tuple[Path, ...]:
    """The listed parts, and those behind them with higher numbers."""
    for name in listed:
        if not (folder / name).is_file():
            raise _missing(folder, name, f"{METADATA_FILE} lists it")
    parts = [folder / name for name in listed]
    bag_name, last = _numbered(parts[-1])
    if last < 0:
        return tuple(parts)
    later = {number: file for file in _files(folder) for name, number in [_numbered(file)] if name == bag_name}
    for number in range(last + 1, max(later, default=last) + 1):
        if number not in later:
            raise _missing(folder, f"{bag_name}_{number}{parts[-1].suffix}", "a later one is there")
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
            raise _missing(folder, f"{name}_{number}{files[0].suffix}", "a later one is there")
    return tuple(found[number] for number in range(max(found) + 1))


def _no_bag(folder: Path) -> BagError:
    """What to say of a folder without a recording, or of nothing."""
    expected = f"expected a bag folder with {', '.join(SUFFIXES[:-1])} or {SUFFIXES[-1]} files, or one such file"
    if not folder.is_dir():
        return BagError(f"{folder} does not exist; {expected}")
    names = sorted(file.name + ("/" if file.is_dir() else "") for file in folder.iterdir())
    said = ", ".join(names[:5]) + (", ..." if len(names) > 5 else "")
    return BagError(f"{folder} is a folder without a bag: it has {said or 'no files'}; {expected}")


def _missing(folder: Path, name: str, reason: str) -> BagError:
    return BagError(
        f"{folder}: the part {name} of the bag is missing, {reason}; put it back, or copy the other parts to a folder with another "
        "name and read them one by one"
    )
