"""Changes of files: with nothing renewed, or with their digests."""

from __future__ import annotations

import random
from pathlib import Path

from advnerf_core.documents import read_json
from advnerf_core.report.evidence.page import film_of, picture_of
from advnerf_core.report.evidence.registration import WITHDRAWN
from advnerf_core.report.evidence.verifying.digests import write_known_digest
from advnerf_core.report.evidence.verifying.layout import DIGESTS, PAGE, SET
from advnerf_core.report.evidence.verifying.victims import DECLARED
from benchmarks.planting.world import World


def a_digit(world: World) -> None:
    """Another digit in some file of the set."""
    _other_digit(world.rng.choice(_with_digits(world)), world.rng)


def a_digit_with_its_digest(world: World) -> None:
    """Another digit in some file of the set, with the digests renewed."""
    _other_digit(world.rng.choice([file for file in _with_digits(world) if not file.match(SET)]), world.rng)
    world.renew_digests()


def a_number_of_the_manifest(world: World) -> None:
    """Another excess in ``set.json``, with its digest and the page renewed."""
    from advnerf_core.report.evidence.publishing import write_page

    data = read_json(world.folder / SET)
    world.rng.choice(data["rows"])["excess_m"] += world.rng.choice([0.01, -0.01, 0.1])
    world.put(world.folder / SET, data)
    write_known_digest(world.folder)
    write_page(world.published)


def deployed_through(world: World) -> None:
    """Another backend that the set says it was deployed through, with its digest and the page renewed."""
    from advnerf_core.report.evidence.publishing import write_page

    data = read_json(world.folder / SET)
    world.put(world.folder / SET, {**data, "deployed_through": ["car"]})
    write_known_digest(world.folder)
    write_page(world.published)


def the_page(world: World) -> None:
    """Another digit on the page of all sets."""
    _other_digit(world.published / PAGE, world.rng)


def a_picture(world: World) -> None:
    """Another picture of the set."""
    _replace_a_byte(world.published / picture_of(world.name), world.rng)


def a_picture_with_its_digest(world: World) -> None:
    """A picture of something else, with its digest renewed."""
    from PIL import Image

    file = world.published / picture_of(world.name)
    with Image.open(file) as picture:
        turned = picture.transpose(Image.Transpose.FLIP_LEFT_RIGHT)
    turned.save(file)
    world.renew_digests()


def a_film(world: World) -> None:
    """Another film of the set."""
    _replace_a_byte(world.published / film_of(world.name), world.rng)


def a_film_with_its_digest(world: World) -> None:
    """Another film of the set, with its digest renewed."""
    a_film(world)
    world.renew_digests()


def the_reference_build(world: World) -> None:
    """Another scene or victim in the reference build."""
    _replace_a_byte(_reference(world), world.rng)


def the_reference_build_with_its_digest(world: World) -> None:
    """Another scene or victim in the reference build, with its digest renewed."""
    the_reference_build(world)
    world.renew_digests()


def a_file_more(world: World) -> None:
    """A file that nobody published."""
    name = world.rng.choice(["gate/more_hardened.json", "predictions/more.json", "set/notes.json"])
    file = world.folder / name
    file.parent.mkdir(exist_ok=True)
    world.put(file, {"key": "0"})


def a_file_less(world: World) -> None:
    """A file of the set is gone."""
    world.rng.choice([file for file in _files(world) if not file.match(SET)]).unlink()


def a_given_reason(world: World) -> None:
    """Another reason for what was given up or is declared, with everything renewed."""
    files = [world.folder / name for name in (WITHDRAWN, DECLARED)]
    file = world.rng.choice([each for each in files if each.exists()])
    world.put(file, dict.fromkeys(read_json(file), "It was of no importance to the question."))
    world.renew_all()


def a_digest(world: World) -> None:
    """Another digest of the set in the list of all sets."""
    known = read_json(world.published / DIGESTS)
    world.put(world.published / DIGESTS, {**known, world.name: f"{world.rng.getrandbits(256):064x}"})


def _files(world: World) -> list[Path]:
    return sorted(file for file in world.folder.rglob("*.json"))


def _with_digits(world: World) -> list[Path]:
    return [file for file in _files(world) if any(letter.isdigit() for letter in file.read_text())]


def _reference(world: World) -> Path:
    stages = world.published / "reference"
    return world.rng.choice(
        sorted(
            file
            for part in ("scene", "policy")
            for file in stages.glob(f"{part}_*/*")
            if file.suffix in (".safetensors", ".json")
        )
    )


def _other_digit(file: Path, rng: random.Random) -> None:
    text = file.read_text()
    place = rng.choice([place for place, letter in enumerate(text) if letter.isdigit()])
    other = rng.choice([digit for digit in "0123456789" if digit != text[place]])
    file.write_text(text[:place] + other + text[place + 1 :])


def _replace_a_byte(file: Path, rng: random.Random) -> None:
    data = bytearray(file.read_bytes())
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
    file.write_bytes(bytes(data))
