"""The command ``advnerf verify``: computes published numbers again from the kept drives."""

from __future__ import annotations

import subprocess
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated

import typer

from advnerf_core.errors import ConfigError
from advnerf_core.run_module import module_command
from nodes.cli.cell_choice import CellChoice, load_cells
from nodes.runtime.terminal import fail_unless, say_error

# What ``advnerf audit`` leaves in its folder.
AUDIT = "audit.json"
# Looked for only where sets are verified: an audit's folder may lie anywhere.
_PUBLISHED = Path("docs/results")


def verify(
    name: Annotated[
        str | None,
        typer.Argument(metavar="SET", help="Name of a set, or folder of an audit.", show_default="all sets"),
    ] = None,
    folder: Annotated[
        Path | None,
        typer.Option(
            "--folder",
            help="Folder of all published sets.",
            exists=True,
            file_okay=False,
            show_default=str(_PUBLISHED),
        ),
    ] = None,
    again: Annotated[
        int,
        typer.Option("--redrive", min=0, help="Also drive so many cells again, in the surrogate."),
    ] = 0,
    seed: Annotated[int, typer.Option(help="Which cells are drawn for that.")] = 0,
) -> None:
    """Compute every published number again from the kept drives, and check digests, registration, completeness and the history in git."""
    from advnerf_core.report.evidence.registration import SetError
    from advnerf_core.report.evidence.verify import verify_beside, verify_set
    from advnerf_core.report.evidence.verifying.layout import sets_in
    from advnerf_core.report.evidence.verifying.pictures import picture_problems
    from nodes.experiment.run.kept_attacks import with_attacks
    from nodes.experiment.run.redrive import RedriveError

    if name is not None and (Path(name) / AUDIT).is_file():
        if again:
            raise ConfigError(
                "expected no --redrive with the folder of an audit, of which nothing is driven again; leave it out"
            )
        _audit(Path(name))
        return
    published = _PUBLISHED if folder is None else folder
    if not published.is_dir():
        raise ConfigError(
            f"expected the folder of all published sets, or the folder of an audit as SET, got {published}, which does not exist; give --folder"
        )
    known = sets_in(published)
    if name is not None and name not in known:
        raise SetError(
            f"expected a set of {', '.join(known) or 'none that is registered'} in {published}, got {name!r}"
        )
    wrong = 0
    for each in [name] if name is not None else known:
        found = with_attacks(verify_set(published / each), published / each)
        if found.awaits:
            said = f"{found.drives} drives of a set under way, which awaits {found.awaits} registered cells"
            wrong += _say(f"{found.name}: {said}", found.problems)
            continue
        wrong += _say(f"{found.name}: {found.numbers} numbers from {found.drives} drives", found.problems)
        for finding in found.findings:
            print(f"  declared: {finding}")
        if not found.problems:
            wrong += _say_problems(list(picture_problems(published / each)))
        if again and not found.problems:
            try:
                wrong += _redrive(published / each, again, seed)
            except RedriveError as error:  # of all sets, those that are kept are driven
                say_error(f"nothing was driven again: {error}")
                wrong += name is not None
    wrong += _say("page, pictures, films and reference build", verify_beside(published))
    wrong += _history(published)
    wrong += 0 if name else _ledger(published)
    fail_unless(not wrong)


def _audit(folder: Path) -> None:
    """Compute an audit's numbers again from its drives."""
    from nodes.audit.kept import check_audit

    for line in check_audit(folder):
        print(line)


def _say(what: str, problems: Sequence[str]) -> int:
    """Print a verdict and its problems; returns how many there are."""
    print(f"{what}: {f'{len(problems)} problems' if problems else 'all as published'}")
    return _say_problems(problems)


def _say_problems(problems: Sequence[str]) -> int:
    for problem in problems:
        say_error(problem)
    return len(problems)


def _history(published: Path) -> int:
    """Hold everything against the history of the repository; how many problems there are."""
    from advnerf_core.report.evidence.verifying.history import verify_history

    found = verify_history(published)
    if found.not_checked:
        print(f"history not checked: {found.not_checked}")
        return 0
    return _say(f"history of {found.files} files, {found.removed} removals logged", found.problems)


def _ledger(published: Path) -> int:
    """Let the benchmarks of the checkout that this is run in check rows and pages; how many problems there are."""
    from advnerf_core.documents import parse_json

    root = published.resolve().parent.parent
    if root != Path.cwd() or not (root / "benchmarks" / "published_check.py").exists():
        print("rows and pages not checked: run it in the checkout, whose benchmarks compute them again")
        return 0
    command = module_command("benchmarks.published_check")
    ended = subprocess.run(command, cwd=root, capture_output=True, text=True, check=False)
    if ended.returncode:
        return _say(
            "rows and pages",
            (ended.stderr.strip().splitlines() or ["benchmarks.published_check failed"])[-1:],
        )
    found = parse_json(ended.stdout, "benchmarks.published_check")
    numbers = found["numbers"]
    what = (
        f"{found['rows']} rows computed again, {found['not_kept']} measured once; numbers on pages: {numbers['published']} of rows and sets, "
        f"{numbers['marked']} marked as measured once, {numbers['settings']} settings"
    )
    return _say(what, found["problems"])


def _redrive(folder: Path, count: int, seed: int) -> int:
    """Drive some cells of a set again; how many came out otherwise."""
    from advnerf_core.report.evidence.kept_build import LOST, is_kept
    from advnerf_core.report.evidence.registration import read_registration, registered_file
    from nodes.experiment.run.redrive import TOLERANCE_M, RedriveError, kept_victims, redrive, unreadable

    registration = read_registration(folder)
    assert registration is not None, "the set was verified"
    if not is_kept(folder):
        raise RedriveError(f"{folder.name} {LOST}")
    file = registered_file(registration.file)
    if not file.is_file():
        raise RedriveError(
            f"{folder.name}: expected the experiment file {file.name} that was registered in launch/ or in this folder, found none; change to the folder "
            "that it was registered in"
        )
    with TemporaryDirectory() as run:
        changes = [*registration.overrides, *kept_victims(folder, Path(run) / "victims")]
        choice = CellChoice(file, registration.setting, Path(run) / "run", overrides=changes)
        try:
            experiment, _ = load_cells(choice)
        except ConfigError as error:  # the file, or a key that was set, has another name by now
            raise unreadable(folder, str(error)) from None
        ended = redrive(experiment, folder, count, seed, print)
    for each in ended:
        verdict = "as published" if each.same else f"otherwise: more than {TOLERANCE_M} m"
        print(f"{each.name}: at most {each.off_m:.4f} m from the published poses, {verdict}")
    return sum(not each.same for each in ended)
