"""The methods of attack: one table of the built-in ones, and those that users bring as an entry point or a file.

A method is a function ``search(problem, settings, run)`` that returns a `SearchResult`, and one `Method` that says what the
search needs. A built-in one is a row of `METHODS`; a user's is an entry point of the group ``advnerf.methods`` or ``file.py:Name``, see
docs/methods.md. ``none`` is not a method but a condition (`advnerf_core.report.conditions`): there is nothing to search.

Names and needs are known without torch: the code of a built-in method is imported when it is first called.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from advnerf_core.errors import AdvnerfError
from advnerf_core.plugins import (
    PluginError,
    code_sha256,
    fields_of,
    known_names,
    name_in_results,
    options_of,
    require_known,
    resolve,
    unknown,
)
from advnerf_core.policies.architecture import PILOTNET, Architecture, require_architecture
from advnerf_core.report.conditions import CONDITIONS
from advnerf_core.strict import is_of_settings

if TYPE_CHECKING:
    from advnerf_core.attack.problem import AttackProblem
    from advnerf_core.attack.search.record import OnEvaluation, SearchResult

GROUP = "advnerf.methods"
_WHAT = "attack method"
# Adam's step along a gradient of colours. In each of four pairs of searches in the room, the car deviated more than with steps of 0.1.
GRADIENT_RATE = 0.3

# Names become parts of file names.
_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")


class MethodError(AdvnerfError, ValueError):
    """A method was given options that it does not have, or does not keep its contract."""


@dataclass(frozen=True)
class SearchSettings:
    """Budget and settings of a search. A method ignores those that do not concern it.

    Attributes:
        evaluations: Budget: closed-loop drives from all start poses, or as many policy calls as these make.
        learning_rate: Step of the method's optimiser; None for the method's own default.
        sigma: Spread of the method's candidates; None for the method's own default.
        population: Candidates of a generation.
        cells: Cells along an edge of coarse textures, where a method searches or draws these; 0 for the objects' own grids.
        probes: Pairs of textures queried after each drive; None for the method's own default.
        warm_pairs: Pairs of a student's first lesson; None for the default.
        gradient_rate: Step of Adam along a gradient, unless ``learning_rate`` or the sensor gives another one.
        random_sigma: Spread of random textures' theta, unless ``sigma`` or the sensor gives another one.
        options: The method's own options: its `Method.Options`.
    """

    evaluations: int = 50
    learning_rate: float | None = None
    sigma: float | None = None
    population: int = 10
    cells: int = 8
    probes: int | None = None
    warm_pairs: int | None = None
    gradient_rate: float = GRADIENT_RATE
    random_sigma: float = 5.0
    options: Any = None


@dataclass(frozen=True)
class StudentOptions:
    """Options of the methods ``distilled`` and ``guided``.

    Attributes:
        student: Architecture of the student: a name, or ``file.py:Class`` relative to the working folder.
    """

    student: str = PILOTNET
    configuration: Mapping[str, Any] = field(default_factory=dict)

    def __post_init__(self) -> None:
        try:
            require_architecture(self.student, None, self.configuration)
        except AdvnerfError as error:
            raise ValueError(str(error)) from None

    @property
    def architecture(self) -> Architecture:
        """The architecture with its settings."""
        return Architecture(self.student, self.configuration)


@dataclass(frozen=True, eq=False)
class SearchRun:
    """One run of a search.

    Attributes:
        seed: Seed of all random draws.
        state_path: State file, written after every evaluation; if it exists, the search resumes from it. None keeps none.
        on_evaluation: Called after every evaluation, when the state is on disk; an exception ends the search.
        settings_hash: Hash of scene, policy and configuration; a state file of another one is refused.
    """

    seed: int = 0
    state_path: Path | None = None
    on_evaluation: OnEvaluation | None = None
    settings_hash: str = ""


FRESH_RUN = SearchRun()
"""Seed 0, no state file, no callback."""

Search = Callable[["AttackProblem", SearchSettings, SearchRun], "SearchResult"]
Planned = Callable[["AttackProblem", SearchSettings], int]


def _all_evaluations(problem: AttackProblem, settings: SearchSettings) -> int:
    del problem
    return settings.evaluations


@dataclass(frozen=True)
class Method:
    """A method of attack. Its name is its row's, its entry point's, or its attribute's in the file.

    Attributes:
        search: ``search(problem, settings, run)`` maximises the objective of a problem within the budget.
        needs_gradient: Whether it needs a policy with a gradient; else it only queries the policy.
        single_images: Whether it queries single images outside a drive, which a policy with a memory cannot answer.
        reads_scale: Whether it asks the sensor for the scale of theta (`search.gradient_step`, `search.random_spread`), so that it also
            searches shapes; else theta must be colours.
        evaluations: ``evaluations(problem, settings)``: number of drives that the budget allows, for the progress.
        Options: Dataclass or pydantic model of options that only this method has; None if it has none.
        title: Title for readers, in a few words; empty for its name.
    """

    search: Search
    needs_gradient: bool = False
    single_images: bool = False
    reads_scale: bool = False
    evaluations: Planned = _all_evaluations
    Options: type[Any] | None = None
    title: str = ""

    def __post_init__(self) -> None:
        if self.Options is not None and not is_of_settings(self.Options):
            raise MethodError(
                f"expected Options to be a dataclass or a pydantic model, got {self.Options!r:.80}"
            )

    def options(self, written: Mapping[str, Any], key: str = "options") -> Any:
        """The options in the form that `SearchSettings` carries.

        Args:
            written: Keys and values as a user wrote them.
            key: Prefix of each key in messages.

        Raises:
            MethodError: An unknown key, or a wrong value.
        """
        return options_of(self.Options, written, "option of this method", key, MethodError)

    def own_options(self, written: Mapping[str, Any], key: str = "options") -> Any:
        """As `options`, of what is written for several methods: keys that this one does not have are for the others (`require_options`)."""
        own = fields_of(self.Options)
        return self.options({name: value for name, value in written.items() if name in own}, key)


def _late(module: str, function: str = "search", *first: str) -> Callable[..., Any]:
    """A function of a module beside the searches, with its first arguments; the module is imported when it is first called."""

    def call(*arguments: Any) -> Any:
        return getattr(import_module(f"advnerf_core.attack.search.{module}"), function)(*first, *arguments)

    return call


# In the order of tables. A method is one row here and a function in `search/`.
METHODS: Mapping[str, Method] = MappingProxyType(
    {
        "random": Method(_late("random_search"), reads_scale=True),
        "random_coarse": Method(_late("random_families", "search", "random_coarse")),
        "random_levels": Method(_late("random_families", "search", "random_levels")),
        "random_pink": Method(_late("random_families", "search", "random_pink")),
        "random_natural": Method(_late("random_families", "search", "random_natural")),
        "cem": Method(_late("cem")),
        "evolution": Method(_late("evolution")),
        "gradient": Method(_late("gradient"), needs_gradient=True, reads_scale=True),
        "gradient_coarse": Method(_late("gradient", "search_coarse"), needs_gradient=True),
        "frame": Method(_late("frame"), needs_gradient=True, single_images=True),
        "guided": Method(
            _late("black_box", "search_as", "guided"),
            single_images=True,
            evaluations=_late("black_box", "planned_evaluations", "guided"),
            Options=StudentOptions,
        ),
        "distilled": Method(
            _late("black_box", "search_as", "distilled"),
            single_images=True,
            evaluations=_late("black_box", "planned_evaluations", "distilled"),
            Options=StudentOptions,
        ),
    }
)


def load_method(reference: str, folder: Path | None = None) -> Method:
    """The method that a reference names.

    Args:
        reference: A built-in name, an entry point's name, or ``file.py:Name``.
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: The method is unknown, its code cannot be loaded, or it is not a `Method`.
    """
    require_method(reference, folder)
    found: Any = resolve(reference, _WHAT, {name: _row(name) for name in METHODS}, GROUP, folder)
    if not isinstance(found, Method):
        raise PluginError(
            f"{_WHAT} {reference}: expected a Method (advnerf_core/attack/methods.py), got {_described(found)}; see docs/methods.md"
        )
    return found


def require_method(reference: str, folder: Path | None = None) -> None:
    """Raise unless a reference names a method; nothing is loaded.

    Raises:
        PluginError: The method is unknown, or its name is ambiguous.
    """
    require_known(reference, _WHAT, METHODS, GROUP, folder)
    name = name_in_results(reference)
    if not _NAME.fullmatch(name):
        raise PluginError(
            f"{_WHAT} {reference}: expected a name of letters, digits, - and _, as it becomes part of file names, got {name!r}; rename it"
        )
    taken = tuple(dict.fromkeys((*CONDITIONS, *method_names())))
    if name in taken and reference not in method_names():
        raise PluginError(
            f"{_WHAT} {reference}: expected a name that no other condition has, got {name} of {', '.join(taken)}; rename it"
        )


def require_options(methods: Mapping[str, Method], written: Mapping[str, Any], key: str = "options") -> None:
    """Raise for options that are written for several methods, by name, if none of them has one, or a value is wrong.

    Raises:
        MethodError: Such a key, with the options of each method, or such a value.
    """
    has = {name: fields_of(method.Options) for name, method in methods.items()}
    known = [option for options in has.values() for option in options]
    for name in written:
        if name not in known:
            each = ", ".join(
                f"{method} has {', '.join(options) or 'none'}" for method, options in has.items()
            )
            raise MethodError(f"{key}.{name}: {unknown(name, 'option of a listed method', known)}; {each}")
    for method in methods.values():
        method.own_options(written, key)


def method_digest(reference: str) -> str:
    """Names the code of a user's method in 16 characters: it changes with the files of the code. Empty for a built-in one."""
    return code_sha256(reference, METHODS, GROUP)[:16]


def method_names() -> tuple[str, ...]:
    """Names of the built-in methods, then of methods in installed packages."""
    return known_names(METHODS, GROUP)


def black_box_methods(stateless: bool = True) -> tuple[str, ...]:
    """Built-in methods that only query a policy for its answers.

    Args:
        stateless: Whether the policy has no memory.
    """
    return tuple(
        name
        for name, row in METHODS.items()
        if not row.needs_gradient and (stateless or not row.single_images)
    )


def alternatives(names: Iterable[str]) -> str:
    """Names as text: ``a, b or c``."""
    *first, last = names
    return f"{', '.join(first)} or {last}" if first else last


def _row(name: str) -> Callable[[], Method]:
    return lambda: METHODS[name]


def _described(found: Any) -> str:
    return (
        f"the class {found.__name__}"
        if isinstance(found, type)
        else f"an object of type {type(found).__name__}"
    )
