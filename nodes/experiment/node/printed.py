"""Printed results of a search: each total beside the total of the drive without an attack."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.printing.pages import pdf_bytes
from advnerf_core.attack.printing.poster import Poster, PrintError, png_bytes
from advnerf_core.attack.printing.record import SUFFIX, PrintRecord, poster_record, require_free
from advnerf_core.attack.printing.sheet import metres
from advnerf_core.attack.printing.tiles import Paper, layout_of
from advnerf_core.files import write_atomically


def in_one_line(attack: AttackFile) -> str:
    """The attack's total, and the policy's without it; before them the value of another objective than the total."""
    total = "unknown" if attack.predicted_total_cte_m is None else f"{attack.predicted_total_cte_m:.2f} m"
    clean = "without attack not driven" if attack.clean_drive is None else attack.clean_drive.short
    value = attack.objective_in_words
    said = f"{attack.method}, {value}; " if value else f"{attack.method}, "
    return f"attack {attack.attack_id}, {said}predicted total CTE {total}, {clean}"


def stem_of(file: Path) -> str:
    """Name of an attack file without its ending: files that are made of it are called by it."""
    return file.name.removesuffix(".safetensors").removesuffix(".attack") or file.stem


def export_attack(attack: AttackFile, folder: Path, stem: str) -> list[Path]:
    """Write the texture of an attack's face as ``<stem>.texture.png``, and its meshes as ``<stem>.<number>_<name>.glb``."""
    from advnerf_core.data.image_files import write_image

    written: list[Path] = []
    if attack.face is not None:
        written.append(folder / f"{stem}.texture.png")
        write_image(written[-1], attack.face.texture)
    for number, each in enumerate(attack.objects):
        if each.glb:
            written.append(folder / f"{stem}.{number}_{each.name}.glb")
            write_atomically(written[-1], each.glb)
    return written


def write_poster(
    poster: Poster, target: Path, paper: Paper, dpi: float, margin_mm: float, overlap_mm: float
) -> str:
    """Write a poster as PDF or PNG, by the file's suffix; returns a description of the file.

    Raises:
        PrintError: The file is of another kind, or the measures do not fit together.
    """
    size = metres(poster.size_m)
    if poster.frame is not None:
        size += f", {metres(poster.frame.sheet_m)} with its markers"
    if target.suffix.lower() == ".png":
        write_atomically(target, png_bytes(poster, dpi))
        return f"written: {target}, {size}; print at 100 %"
    if target.suffix.lower() != ".pdf":
        raise PrintError(f"expected a .pdf or .png file to write, got {target}; correct --output")
    layout = layout_of(poster.sheet_mm, paper, margin_mm, overlap_mm)
    write_atomically(target, pdf_bytes(poster, layout, paper, dpi))
    count, paper_name = layout.rows * layout.columns, "this size" if paper == "none" else paper.title()
    pages = f"{count} page{'s' * (count > 1)} of {paper_name}"
    return f"written: {target}, {size}, {pages} and an overview; print at 100 %, no fit to page"


def record_beside(poster: Poster, attack_file: Path, printed: Path, dpi: float) -> tuple[PrintRecord, Path]:
    """Sizes and markers of a poster, and the path beside its file where they are written.

    Raises:
        PrintError: The record of another print is there.
    """
    path = printed.with_suffix(SUFFIX)
    record = poster_record(poster, attack_file, path.parent, dpi)
    require_free(path, record)
    return record, path


def print_attacks(files: Sequence[Path]) -> None:
    """A line for each attack file, and the warning if the policy does not drive without an attack."""
    warnings: list[str] = []
    for file in files:
        attack = load_attack(file)
        print(f"{file}: {in_one_line(attack)}")
        if attack.clean_drive is not None and attack.clean_drive.warning not in ("", *warnings):
            warnings.append(attack.clean_drive.warning)
    for warning in warnings:
        print(warning)
