import importlib
import pkgutil
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Literal

import pytest
from pydantic import BaseModel, Field, TypeAdapter, ValidationError

from advnerf_core.documents import Document, parse_yaml
from advnerf_core.errors import ConfigError
from advnerf_core.strict import StrictModel, validate

PACKAGES = ("advnerf_core", "hardware", "calibration", "nodes")


@dataclass(frozen=True)
class Gains:
    gain: float = 1.0
    type: int = 3


class PlugIn(BaseModel):
    steps: int = 1


class Config(StrictModel):
    speed_mps: float = 1.0
    horizon: int = Field(default=3, ge=1)
    raw: bool = False
    gains: Gains = Gains()
    row: tuple[float, ...] = ()
    by_name: dict[str, float | None] = Field(default_factory=dict)
    inside: list["Config"] = Field(default_factory=list)
    division: Literal[1, 2] = 1
    plug_in: PlugIn = PlugIn()
    many: list[Gains] = Field(default_factory=list)
    file: Path = Path("a")


def read(text, model=Config):
    return validate(model, parse_yaml(text, "a.yaml"))


@pytest.mark.parametrize("word", ["on", "yes", "true", "3:14", "'3'", "1_000"])
@pytest.mark.parametrize(
    "key",
    [
        "speed_mps: {}", "horizon: {}", "gains: {{gain: {}}}", "gains: {{type: {}}}", "row: [1, {}]", "by_name: {{a: {}}}",
        "inside: [{{speed_mps: {}}}]", "division: {}", "plug_in: {{steps: {}}}", "many: [{{}}, {{gain: {}}}]",
    ],
)  # fmt: skip
def test_only_a_number_is_a_number(key, word):
    with pytest.raises(ConfigError, match=r"^a\.yaml:1: [a-z_.0-9]+: input should be .*, got "):
        read(key.format(word))


@pytest.mark.parametrize("word", ["on", "yes", "1", "0", "'true'"])
def test_only_true_and_false_are_booleans(word):
    with pytest.raises(
        ConfigError, match=r"raw: input should be a valid boolean, got .*; write true or false"
    ):
        read(f"raw: {word}")


def test_whole_numbers_are_numbers_in_either_form():
    config = read("speed_mps: 2\nhorizon: 1e3\ngains: {gain: 1e0, type: 4.0}\nrow: [1, 2.5]\ndivision: 2\n")
    assert (config.speed_mps, config.horizon, config.gains, config.row) == (
        2.0,
        1000,
        Gains(1.0, 4),
        (1.0, 2.5),
    )
    assert [type(each) for each in (config.speed_mps, config.horizon, config.division)] == [float, int, int]


def test_all_problems_of_a_file_are_listed_with_their_lines():
    with pytest.raises(ConfigError) as caught:
        read("speed_mps: on\nhorizn: 3\ngains: {gain: .inf}\ninside:\n- horizon: 0\n- raw: 1\n")
    assert [line.split(": ")[:2] for line in str(caught.value).split("\n  ")] == [
        ["a.yaml:2", "unknown key horizn; valid keys here"], ["a.yaml:1", "speed_mps"], ["a.yaml:3", "gains.gain"],
        ["a.yaml:5", "inside.0.horizon"], ["a.yaml:6", "inside.1.raw"],
    ]  # fmt: skip


def test_unknown_keys_of_dataclasses_are_all_listed():
    with pytest.raises(ConfigError) as caught:
        read("gian: 1\ntipe: 2\n", Gains)
    assert str(caught.value).count("\n") == 1
    assert "a.yaml:2: unknown key tipe; valid keys here: gain, type" in str(caught.value)


@pytest.mark.parametrize("model", [Gains, PlugIn])
def test_a_model_of_a_plug_in_is_as_strict(model):
    with pytest.raises(ConfigError, match=r"a\.yaml:1: .*: input should be a valid .*, got True"):
        read(f"{next(iter(TypeAdapter(model).json_schema()['properties']))}: true", model)


def models():
    found, waiting = set(), [BaseModel]
    while waiting:
        new = waiting.pop().__subclasses__()
        waiting += new
        found |= {model for model in new if model.__module__.split(".")[0] in PACKAGES}
    return sorted(found - {StrictModel}, key=str)


def lax_parts(schema):
    """Numbers and booleans in a core schema that take other types."""
    if isinstance(schema, list | tuple):
        return [lax for each in schema for lax in lax_parts(each)]
    if not isinstance(schema, dict):
        return []
    kind = schema.get("type")
    if kind in ("float", "bool"):
        return [] if schema.get("strict") else [kind]
    if kind == "int":
        return [] if "advnerf_strict" in (schema.get("metadata") or {}) else [kind]
    return [
        lax for key, part in schema.items() if key not in ("metadata", "default") for lax in lax_parts(part)
    ]


def test_every_model_of_the_packages_is_strict():
    for package in map(importlib.import_module, PACKAGES):
        for found in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            source = Path(found.module_finder.path, f"{found.name.split('.')[-1]}.py")
            if source.is_file() and "StrictModel" in source.read_text(encoding="utf-8"):
                importlib.import_module(found.name)
    assert len(models()) > 100
    assert [model for model in models() if not issubclass(model, StrictModel)] == []
    assert {model: lax for model in models() if (lax := lax_parts(model.__pydantic_core_schema__))} == {}


def test_a_model_is_strict_without_a_document_too():
    with pytest.raises(ValidationError):
        Config(speed_mps=True)


class Limits(StrictModel):
    psnr_db: float = 25.0
    T_world_from_car: float = 0.0


class Judged(StrictModel):
    gate: Literal["steering"] | Limits | None = None
    seeds: Annotated[tuple[Annotated[int, Field(ge=0)], ...], Field(min_length=1)] = (0,)


@pytest.mark.parametrize(
    ("written", "told"),
    [
        ({"gate": {"psnr": 3}}, "unknown key gate.psnr; valid keys here: T_world_from_car, psnr_db"),
        ({"gate": {"psnr_db": "x"}}, "gate.psnr_db: input should be a valid number, got 'x'"),
        (
            {"gate": {"T_world_from_car": "x"}},
            "gate.T_world_from_car: input should be a valid number, got 'x'",
        ),
        ({"seeds": [-1]}, "seeds.0: input should be greater than or equal to 0, got -1"),
        ({"seeds": []}, "seeds: expected at least 1, got none"),
    ],
)
def test_a_wrong_value_of_several_types_is_told_once_by_the_key_that_was_written(written, told):
    with pytest.raises(ConfigError) as error:
        validate(Judged, Document(written, "file.yaml"))
    assert str(error.value).splitlines() == [f"file.yaml: {told}"]
