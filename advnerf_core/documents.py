"""The only readers of YAML and JSON text: strict, and every error names its file and line; tables are read by `csv_rows`.

YAML has the core schema of version 1.2: only ``true`` and ``false`` are booleans, ``1e0`` is a number, ``3:14`` is text. A number with
leading zeros is refused, since 1.1 reads ``010`` as 8 and 1.2 as 10. A key that is given twice is an error in every format.
"""

from __future__ import annotations

import codecs
import copy
import json
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from advnerf_core.errors import ConfigError, MissingFileError, UnreadableFileError

Key = tuple[str | int, ...]

_EVENTS: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_DEEPEST = 100
# Aliases repeat content. A file of 1 kB can expand to a billion values.
_MOST_REPEATED = 100_000
_MOST_PROBLEMS, _MOST_ALIKE = 20, 3
_VARYING = re.compile(r"\S*\d\S*")
_TAG = "tag:yaml.org,2002:"
_WORDS = {"": None, "~": None} | {
    form: value
    for word, value in (("null", None), ("true", True), ("false", False))
    for form in (word, word.title(), word.upper())
}
_INTEGER = re.compile(r"[-+]?[0-9]+")
_LEADING_ZERO = re.compile(r"[-+]?0[0-9]+")
_OTHER_BASE = re.compile(r"0o[0-7]+|0x[0-9a-fA-F]+")
_REAL = re.compile(
    r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?|[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"
)
_SPECIAL = re.compile(r"\.(inf|nan)", re.IGNORECASE)
_TYPES: dict[str, tuple[type, ...]] = {
    "null": (type(None),),
    "bool": (bool,),
    "int": (int,),
    "float": (int, float),
}
_JSON_TOKEN = re.compile(r'"(?:[^"\\]|\\.)*"|[{}\[\]:,]', re.DOTALL)


@dataclass
class Document:
    """A parsed YAML file that knows the line of every key.

    Attributes:
        source: File name for error messages.
        places: Origin of each key by its path: ``file:line``, or the override that set it.
    """

    data: Any
    source: str
    places: dict[Key, str] = field(default_factory=dict)

    def place(self, key: Key) -> str:
        """Origin of a key, or of the nearest enclosing key."""
        while key and key not in self.places:
            key = key[:-1]
        return self.places.get(key, self.source)

    def part(self, key: Key) -> Document:
        """Return the section under a key with its places; empty if the key is missing."""
        data = self.data
        for step in key:
            data = (data or {}).get(step) if isinstance(data, dict) else data[step]
        places = {path[len(key) :]: place for path, place in self.places.items() if path[: len(key)] == key}
        places.setdefault((), self.place(key))
        return Document({} if data is None else data, self.source, places)


def one_a_line(problems: Sequence[str]) -> str:
    """Text with a line for each problem. Those that differ only in words with digits, as of many rows, are said once and counted."""
    alike: dict[str, list[str]] = {}
    for problem in problems:
        alike.setdefault(_VARYING.sub("", problem), []).append(problem)
    lines: list[str] = []
    for each in alike.values():
        lines += each if len(each) <= _MOST_ALIKE else [f"{each[0]}; and {len(each) - 1} more like it"]
    more = len(lines) - _MOST_PROBLEMS
    return "\n  ".join([*lines[:_MOST_PROBLEMS], *([f"and {more} more problems"] if more > 0 else [])])


def raise_problems(problems: Sequence[str]) -> None:
    """Raise one `ConfigError` with a line for each problem; nothing without problems."""
    if problems:
        raise ConfigError(one_a_line(problems))


def read_text(path: Path) -> str:
    """Text of a UTF-8 file, without its byte order mark.

    Raises:
        MissingFileError: The file does not exist. It is also a `FileNotFoundError`.
        UnreadableFileError: The file cannot be opened. It is also an `OSError`.
        ConfigError: The file is not UTF-8.
    """
    try:
        content = Path(path).read_bytes()
    except FileNotFoundError:
        raise MissingFileError(f"{path}: expected a file, found none; correct the path") from None
    except OSError as error:
        raise UnreadableFileError(f"{path}: expected a readable file: {error.strerror or error}") from error
    return decode_text(content, str(path))


def decode_text(content: bytes, source: str) -> str:
    """Text of UTF-8 bytes, without their byte order mark; a `ConfigError` names the line that is not UTF-8."""
    if content.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
        raise ConfigError(f"{source}: expected UTF-8, got UTF-16; save the file as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        line = content.count(b"\n", 0, error.start) + 1
        raise ConfigError(
            f"{source}:{line}: expected UTF-8, got the byte 0x{content[error.start]:02x}; save the file as UTF-8"
        ) from None


def read_yaml(path: Path) -> Document:
    """Parse a YAML file. Tags that build objects, repeated keys and ambiguous numbers are refused."""
    return parse_yaml(read_text(path), str(path))


def parse_yaml(text: str, source: str) -> Document:
    """Parse YAML text. Error messages refer to the text as ``source``."""
    try:
        return _Composer(text, source).document()
    except yaml.YAMLError as error:
        mark = getattr(error, "problem_mark", None)
        # The end of the text is reported as the line after the last one.
        line = f":{min(mark.line + 1, max(len(text.splitlines()), 1))}" if mark is not None else ""
        what = " ".join(str(getattr(error, "problem", None) or error).split())
        raise ConfigError(f"{source}{line}: expected valid YAML: {what}") from error


class _Composer:
    """Builds the values of one YAML text from the events of the parser.

    PyYAML's own composer keeps the last of two equal keys, reads version 1.1, and follows an alias into itself.
    """

    def __init__(self, text: str, source: str) -> None:
        self._events: Iterator[Any] = iter(yaml.parse(text.removeprefix("\ufeff"), Loader=_EVENTS))
        self._document = Document({}, source)
        self._problems: list[str] = []
        self._anchors: dict[str, tuple[Any, int]] = {}
        self._open: set[str] = set()
        self._values = self._repeated = 0

    def document(self) -> Document:
        """The whole document; all problems of the text are one error."""
        next(self._events)
        if isinstance(next(self._events), yaml.DocumentStartEvent):
            data = self._value(next(self._events), ())
            next(self._events)
            if not isinstance(event := next(self._events), yaml.StreamEndEvent):
                raise ConfigError(f"{self._at(event)}: expected valid YAML: one document; remove the second")
            self._document.data = {} if data is None else data
        raise_problems(self._problems)
        return self._document

    def _at(self, event: Any) -> str:
        return f"{self._document.source}:{event.start_mark.line + 1}"

    def _value(self, event: Any, key: Key) -> Any:
        self._values += 1
        if isinstance(event, yaml.AliasEvent):
            return self._repeat(event)
        if len(key) > _DEEPEST:
            raise ConfigError(
                f"{self._at(event)}: expected at most {_DEEPEST} levels of nesting; flatten the file"
            )
        self._document.places.setdefault(key, self._at(event))
        before, anchor = self._values, event.anchor
        if anchor is not None:
            self._open.add(anchor)
        if isinstance(event, yaml.ScalarEvent):
            value = self._scalar(event)
        else:
            is_mapping = isinstance(event, yaml.MappingStartEvent)
            if event.tag not in (None, "!", _TAG + ("map" if is_mapping else "seq")):
                self._problems.append(
                    f"{self._at(event)}: expected valid YAML: remove the tag {_short(event.tag)}"
                )
            value = self._mapping(key) if is_mapping else self._sequence(key)
        if anchor is not None:
            self._open.discard(anchor)
            self._anchors[anchor] = (value, self._values - before + 1)
        return value

    def _repeat(self, event: Any) -> Any:
        name = event.anchor
        if name in self._open:
            raise ConfigError(
                f"{self._at(event)}: *{name} is part of the value that it refers to; remove the alias"
            )
        if name not in self._anchors:
            raise ConfigError(
                f"{self._at(event)}: expected an anchor &{name} above *{name}, found none; correct the name"
            )
        value, count = self._anchors[name]
        self._values += count
        self._repeated += count
        if self._repeated > _MOST_REPEATED:
            raise ConfigError(
                f"{self._at(event)}: expected aliases that repeat at most {_MOST_REPEATED} values, got more; write the values out"
            )
        return copy.deepcopy(value)

    def _sequence(self, key: Key) -> list[Any]:
        values: list[Any] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            values.append(self._value(event, (*key, len(values))))
        return values

    def _mapping(self, key: Key) -> dict[Any, Any]:
        values: dict[Any, Any] = {}
        merged: dict[Any, Any] = {}
        seen: set[str] = set()
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            name = self._repeat(event) if isinstance(event, yaml.AliasEvent) else None
            if isinstance(event, yaml.ScalarEvent):
                name = self._scalar(event)
            elif name is None or isinstance(name, dict | list):
                raise ConfigError(
                    f"{self._at(event)}: expected a plain key, got a list or keys; write a word"
                )
            path: Key = (*key, name if isinstance(name, str | int) else str(name))
            if str(name) in seen:
                written = ".".join(map(str, path))
                self._problems.append(f"{self._at(event)}: {written} is given twice; remove one of them")
            seen.add(str(name))
            self._document.places[path] = self._at(event)
            value = self._value(next(self._events), path)
            if name == "<<" and event.implicit[0]:
                merged = self._merged(value, event)
            else:
                values[name] = value
        return {**merged, **values} if merged else values

    def _merged(self, value: Any, event: Any) -> dict[Any, Any]:
        """Keys that ``<<`` takes over; of several sources, the first has precedence."""
        result: dict[Any, Any] = {}
        for each in reversed(value if isinstance(value, list) else [value]):
            if not isinstance(each, dict):
                self._problems.append(f"{self._at(event)}: <<: expected keys and values, got {each!r:.40}")
                continue
            result.update(each)
        return result

    def _scalar(self, event: Any) -> Any:
        tag = event.tag
        if tag == "!" or tag == _TAG + "str" or (tag is None and not event.implicit[0]):
            return event.value
        if tag is None:
            return self._resolve(event)
        types = _TYPES.get(tag.removeprefix(_TAG))
        if types is None:
            self._problems.append(f"{self._at(event)}: expected valid YAML: remove the tag {_short(tag)}")
            return event.value
        value = self._resolve(event)
        if not isinstance(value, types) or (isinstance(value, bool) and bool not in types):
            self._problems.append(
                f"{self._at(event)}: expected a value of the tag {_short(tag)}, got {event.value!r:.40}"
            )
        return float(value) if tag == _TAG + "float" and isinstance(value, int) else value

    def _resolve(self, event: Any) -> Any:
        """Value of a plain scalar in the core schema of YAML 1.2."""
        text = event.value
        if text in _WORDS:
            return _WORDS[text]
        if _LEADING_ZERO.fullmatch(text):
            self._problems.append(
                f"{self._at(event)}: {text}: expected a number without leading zeros, since some readers take it as octal; "
                "remove the zeros, or put text in quotes"
            )
            return text
        try:
            if _INTEGER.fullmatch(text) or _OTHER_BASE.fullmatch(text):
                return int(text, 0)
            return float(_SPECIAL.sub(r"\1", text)) if is_real(text) else text
        except ValueError:
            self._problems.append(f"{self._at(event)}: expected a shorter number, got {len(text)} digits")
            return text


def _short(tag: str) -> str:
    return tag.replace(_TAG, "!!", 1)


class _Dumper(yaml.SafeDumper):
    """Quotes text that `parse_yaml` would not take as text: PyYAML writes version 1.1, in which ``1e0`` is text."""


def _write_text(dumper: Any, text: str) -> Any:
    number = any(form.fullmatch(text) for form in (_INTEGER, _OTHER_BASE, _REAL))
    return dumper.represent_scalar(_TAG + "str", text, style="'" if number else None)


_Dumper.add_representer(str, _write_text)


def dump_yaml(data: Any, **style: Any) -> str:
    """YAML text from which `parse_yaml` reads the same plain data; keys keep their order."""
    return str(yaml.dump(data, Dumper=_Dumper, sort_keys=False, **style))


def is_real(text: str) -> bool:
    """Whether a text is a number as YAML 1.2 writes one, inf and nan included."""
    return _REAL.fullmatch(text) is not None


def read_json(path: Path) -> Any:
    """Content of a JSON file; see `read_text` for the errors of files."""
    return parse_json(read_text(path), str(path))


def read_json_lines(path: Path) -> list[tuple[str, Any]]:
    """Values of a file with one JSON value on each line, each with its ``file:line``; empty lines are skipped."""
    lines = read_text(path).split("\n")
    return [
        (f"{path}:{number}", parse_json(line, str(path), number))
        for number, line in enumerate(lines, 1)
        if line.strip()
    ]


def parse_json(text: str | bytes, source: str, first_line: int = 1) -> Any:
    """Parse JSON text; a key that an object has twice is an error. Errors count lines from ``first_line``."""
    text = decode_text(text, source) if isinstance(text, bytes) else text.removeprefix("\ufeff")
    repeated = False

    def unique(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        nonlocal repeated
        made = dict(pairs)
        repeated = repeated or len(made) != len(pairs)
        return made

    try:
        data = json.loads(text, object_pairs_hook=unique)
    except json.JSONDecodeError as error:
        raise ConfigError(
            f"{source}:{error.lineno + first_line - 1}: expected valid JSON: {error.msg}, column {error.colno}"
        ) from error
    except (RecursionError, ValueError) as error:
        raise ConfigError(f"{source}: expected valid JSON: {error or 'nested too deeply'}") from error
    if repeated:
        raise_problems(_repeated_keys(text, source, first_line))
    return data


def _repeated_keys(text: str, source: str, first_line: int) -> list[str]:
    """A problem for each repeated key of valid JSON text, with its line."""
    problems: list[str] = []
    keys: list[set[str]] = []
    tokens = list(_JSON_TOKEN.finditer(text))
    for token, after in zip(tokens, [*tokens[1:], None], strict=True):
        if token[0] in "{[":
            keys.append(set())
        elif token[0] in "}]":
            keys.pop()
        elif token[0][0] == '"' and after is not None and after[0] == ":":
            name = json.loads(token[0], strict=False)
            if name in keys[-1]:
                line = text.count("\n", 0, token.start()) + first_line
                problems.append(f"{source}:{line}: {name} is given twice; remove one of them")
            keys[-1].add(name)
    return problems
