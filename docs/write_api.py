"""Writes docs/api.md from the docstrings of the public names: ``make api`` (or ``python docs/write_api.py``).

A package's public names are those that its ``__init__.py`` lists. Sources are parsed, not imported, so that the page does not depend
on which extras are installed. `gaps` lists what a docstring owes its reader: the shape of an array, the unit of a number.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from textwrap import dedent, fill

from advnerf_core.files import write_atomically

ROOT = Path(__file__).resolve().parents[1]
PAGE = ROOT / "docs" / "api.md"
PACKAGES = ("advnerf_core", "hardware.worlds", "nodes.runtime", "nodes.bags")
_INTRODUCTION = """# API

The names that other projects import, as in `from advnerf_core import Path`. A package imports the module behind a name when the name is
first used, so `import advnerf_core` loads neither torch nor numpy. [examples/](../examples/README.md) shows them at work.

Metres, radians, seconds. World = the motion-capture frame, z up. Car = under the rear axle, x forward, y left. Cameras have OpenCV axes.
`T_world_from_camera` takes camera coordinates to the world. `[B, H, W, 3]` is the shape of an array; `[m]` is a unit. B counts a batch, T
control ticks, H and W rows and columns of an image, n entries of a car's state (x, y, yaw, and more for some cars).

`make api` writes this page from the docstrings.
"""
_SECTION = re.compile(r"^(Args|Attributes|Returns|Raises):$")
_ITEM = re.compile(r"^(\*{0,2}\w+): ?(.*)$")
_CODE, _NO_BREAK = re.compile(r"`[^`]*`"), "\x00"
_ROLE = re.compile(r":\w+:`~?([^`]+)`")
_CODE_LINE = 110
_LONGEST_DEFAULT = 80
_ARRAYS = frozenset({"Array", "ArrayLike", "NDArray", "Tensor", "Rgb", "Depth", "Grey", "Image"})
# A shape is written as code, ``[B, 3]``; theta has the shape that its sensor says.
_SHAPE = re.compile(r"``[^`]*\[[^`]*``|``theta_shape``|\.theta_shape``")
_REFERENCE = re.compile(r"[Ss]ee :\w+:`")
_UNITS = {
    "_m": "m", "_rad": "rad", "_s": "s", "_mps": "m/s", "_radps": "rad/s", "_1pm": "1/m", "_px": "px", "_hz": "Hz", "_ns": "ns", "_bytes": "bytes",
    "_mib": "MiB", "_db": "dB", "_deg": "deg",
}  # fmt: skip


@dataclass(frozen=True)
class Doc:
    """A docstring in parts.

    Attributes:
        text: Everything in front of the first section.
        sections: Content of each section; named items where it has them, else one item without a name.
    """

    text: str
    sections: dict[str, dict[str, str]] = field(default_factory=dict)

    @property
    def items(self) -> dict[str, str]:
        """Arguments and attributes by name."""
        return {**self.sections.get("Args", {}), **self.sections.get("Attributes", {})}


@dataclass(frozen=True)
class Entry:
    """One public name.

    Attributes:
        package: Package that offers it.
        name: The name.
        module: Module that defines it.
        node: Its definition.
        about: Its docstring.
    """

    package: str
    name: str
    module: str
    node: ast.stmt
    about: str

    @property
    def room(self) -> str:
        """The part of the package that defines it."""
        if not self.module.startswith(self.package):
            return self.module.rsplit(".", 1)[-1]
        return self.module.removeprefix(self.package).lstrip(".").split(".")[0]

    @property
    def anchor(self) -> str:
        """Name of its place on the page."""
        return f"{self.package}.{self.name}"


def entries(package: str) -> list[Entry]:
    """The public names of a package, by the module that defines them; first those that its ``__init__.py`` itself defines."""
    home = {name: module for module, name in _imports_for_type_checkers(package)}
    listed, _ = _definition(package, "__all__")
    assert isinstance(listed, ast.Assign)
    names = [str(name) for name in ast.literal_eval(listed.value)]
    order = list(home)
    names.sort(key=lambda name: order.index(name) if name in home else -1)
    return [
        Entry(package, name, module := home.get(name, package), *_definition(module, name)) for name in names
    ]


def _imports_for_type_checkers(package: str) -> Iterator[tuple[str, str]]:
    for node in _tree(package).body:
        if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING":
            for statement in node.body:
                assert isinstance(statement, ast.ImportFrom), (
                    f"{package} imports whole modules for type checkers"
                )
                yield from ((str(statement.module), alias.name) for alias in statement.names)


def _file(module: str) -> Path:
    path = ROOT / module.replace(".", "/")
    return path / "__init__.py" if path.is_dir() else path.with_suffix(".py")


@cache
def _tree(module: str) -> ast.Module:
    return ast.parse(_file(module).read_text(encoding="utf-8"))


def _definition(module: str, name: str) -> tuple[ast.stmt, str]:
    """The statement that defines a name, and its docstring; that of a variable is the string behind it."""
    body = _tree(module).body
    for node, following in zip(body, [*body[1:], None], strict=True):
        if isinstance(node, ast.FunctionDef | ast.ClassDef) and node.name == name:
            return node, ast.get_docstring(node) or ""
        if isinstance(node, ast.Assign | ast.AnnAssign) and name in _targets(node):
            behind = following.value if isinstance(following, ast.Expr) else None
            text = behind.value if isinstance(behind, ast.Constant) else ""
            return node, dedent(str(text)).strip()
    raise ValueError(f"expected {module} to define {name}, found no such class, function or variable")


def _targets(node: ast.Assign | ast.AnnAssign) -> list[str]:
    targets = node.targets if isinstance(node, ast.Assign) else [node.target]
    return [target.id for target in targets if isinstance(target, ast.Name)]


def parsed(docstring: str) -> Doc:
    """Take a docstring in Google's style apart."""
    text: list[str] = []
    sections: dict[str, list[str]] = {}
    here = text
    for line in docstring.splitlines():
        if header := _SECTION.match(line):
            here = sections.setdefault(header[1], [])
        elif here is not text and line and not line.startswith(" "):
            here = text  # a paragraph behind a section
            text += ["", line]
        else:
            here.append(line)
    return Doc("\n".join(text).strip(), {name: _items(lines) for name, lines in sections.items()})


def _items(lines: list[str]) -> dict[str, str]:
    items: dict[str, list[str]] = {}
    name = ""
    for line in dedent("\n".join(lines)).strip().splitlines():
        if found := _ITEM.match(line):
            name = found[1].lstrip("*")
            items[name] = [found[2]]
        else:
            items.setdefault(name, []).append(line.strip())
    return {key: " ".join(filter(None, value)) for key, value in items.items()}


def written() -> str:
    """The page, from the sources as they are now."""
    parts = [_INTRODUCTION, "| package | room | names |", "|---|---|---|"]
    listed = {package: entries(package) for package in PACKAGES}
    for package, found in listed.items():
        for room in dict.fromkeys(entry.room for entry in found):
            names = ", ".join(f"[{entry.name}](#{entry.anchor})" for entry in found if entry.room == room)
            parts.append(f"| [{package}](#{package}) | {room} | {names} |")
    for package, found in listed.items():
        about = (ast.get_docstring(_tree(package)) or "").split("\n\n")[0]
        parts += ["", f'## <a id="{package}"></a>{package}', _plain(about)]
        for entry in found:
            parts += ["", *_rendered(entry)]
    return "\n".join(parts) + "\n"


def _rendered(entry: Entry) -> Iterator[str]:
    doc, node = parsed(entry.about), entry.node
    path = _file(entry.module).relative_to(ROOT)
    yield f'### <a id="{entry.anchor}"></a>[{entry.name}](../{path})'
    if heading := _heading(entry):
        yield from ("```python", heading, "```")
    yield _paragraphs(doc.text)
    types = _field_types(node) if isinstance(node, ast.ClassDef) else {}
    yield from _bullets(doc, "", types)
    if isinstance(node, ast.ClassDef):
        yield from _members(node)


def _heading(entry: Entry) -> str:
    """What stands in the code block; nothing for a class of fields, because these are listed with their types."""
    node = entry.node
    if isinstance(node, ast.FunctionDef):
        return _signature(node)
    if isinstance(node, ast.AnnAssign):
        return f"{entry.name}: {_text(node.annotation)}"
    if not isinstance(node, ast.ClassDef):
        return ""
    for member in node.body:
        if isinstance(member, ast.FunctionDef) and member.name == "__init__":
            return _call(node.name, _parameters(member), "")
    bases = [ast.unparse(base) for base in node.bases]
    return f"class {node.name}({', '.join(bases)})" if bases and not _field_types(node) else ""


def _signature(node: ast.FunctionDef, owner: str = "") -> str:
    decorators = [ast.unparse(decorator) for decorator in node.decorator_list]
    if "property" in decorators or "cached_property" in decorators:
        return f"{node.name}: {_text(node.returns)}"
    returns = "" if node.returns is None or _text(node.returns) == "None" else f" -> {_text(node.returns)}"
    prefix = f"{owner}." if "classmethod" in decorators or "staticmethod" in decorators else ""
    return _call(prefix + node.name, _parameters(node), returns)


def _call(name: str, parameters: list[str], returns: str) -> str:
    line = f"{name}({', '.join(parameters)}){returns}"
    if len(line) <= _CODE_LINE:
        return line
    return f"{name}(\n" + "".join(f"    {parameter},\n" for parameter in parameters) + f"){returns}"


def _text(node: ast.expr | None) -> str:
    return "" if node is None else ast.unparse(node)


def _parameters(node: ast.FunctionDef) -> list[str]:
    given = node.args
    plain = [*given.posonlyargs, *given.args]
    defaults: list[ast.expr | None] = [*[None] * (len(plain) - len(given.defaults)), *given.defaults]
    texts = [_parameter(each, default) for each, default in zip(plain, defaults, strict=True)]
    if given.posonlyargs:
        texts.insert(len(given.posonlyargs), "/")
    if plain and plain[0].arg in ("self", "cls"):
        texts = texts[1:]
    if given.vararg is not None:
        texts.append("*" + _parameter(given.vararg, None))
    elif given.kwonlyargs:
        texts.append("*")
    texts += [
        _parameter(each, default) for each, default in zip(given.kwonlyargs, given.kw_defaults, strict=True)
    ]
    return texts


def _parameter(each: ast.arg, default: ast.expr | None) -> str:
    text = each.arg + (f": {_text(each.annotation)}" if each.annotation is not None else "")
    return text if default is None else f"{text} = {_text(default)}"


def _is_dataclass(node: ast.ClassDef) -> bool:
    is_tuple = any(ast.unparse(base) == "NamedTuple" for base in node.bases)
    return is_tuple or any(
        ast.unparse(decorator).startswith("dataclass") for decorator in node.decorator_list
    )


def _fields(node: ast.ClassDef) -> list[ast.AnnAssign]:
    """Fields that the constructor of a dataclass takes."""
    found = [member for member in node.body if isinstance(member, ast.AnnAssign)]
    return [member for member in found if "init=False" not in _text(member.value)]


def _field_types(node: ast.ClassDef) -> dict[str, str]:
    """Type and default of each field of a class, by name."""
    found = {}
    for member in node.body:
        if isinstance(member, ast.AnnAssign):
            default = _default(member.value)
            shown = f" = {default if len(default) <= _LONGEST_DEFAULT else '...'}" if default else ""
            found[_text(member.target)] = f"{_text(member.annotation)}{shown}"
    return found


def _default(value: ast.expr | None) -> str:
    """Default of a field; that of ``Field(...)`` is an argument of it."""
    if not (isinstance(value, ast.Call) and _text(value.func) in ("field", "Field")):
        return _text(value)
    named = {keyword.arg: _text(keyword.value) for keyword in value.keywords}
    return _text(value.args[0]) if value.args else named.get("default", "...")


def _methods(node: ast.ClassDef) -> list[ast.FunctionDef]:
    own = [member for member in node.body if isinstance(member, ast.FunctionDef)]
    public = [member for member in own if not member.name.startswith("_") or member.name == "__call__"]
    return [member for member in public if "overload" not in map(ast.unparse, member.decorator_list)]


def _members(node: ast.ClassDef) -> Iterator[str]:
    methods = _methods(node)
    if methods:
        yield "\n*Methods and properties*\n" if parsed(ast.get_docstring(node) or "").items else ""
    for member in methods:
        doc = parsed(ast.get_docstring(member) or "")
        signature = " ".join(_signature(member, node.name).split()).replace("( ", "(").replace(", )", ")")
        yield _wrapped(f"- **`{signature}`**: {_plain(' '.join(doc.text.split()))}", "  ")
        yield from _bullets(doc, "  ", {})


def _bullets(doc: Doc, indent: str, types: dict[str, str]) -> Iterator[str]:
    """Sections as lists; ``types`` are those of named items, where the signature does not show them."""
    for section, items in doc.sections.items():
        if not indent:
            yield ""
        for name, text in items.items():
            if section in ("Args", "Attributes"):
                label = f"`{name}: {types[name]}`" if name in types else f"`{name}`"
            else:
                label = f"*{section}*" + (f" `{name}`" if name else "")
            yield _wrapped(f"{indent}- {label}: {_plain(text)}", indent + "  ")


def _paragraphs(text: str) -> str:
    """Prose as Markdown; what is indented is code."""
    parts = []
    for paragraph in text.split("\n\n"):
        if paragraph.startswith(" "):
            parts.append(f"```\n{dedent(paragraph)}\n```")
        else:
            parts.append(_wrapped(_plain(paragraph)))
    return "\n\n".join(parts)


def _wrapped(text: str, indent: str = "") -> str:
    """Lines of 100 columns; what stands between backticks is not broken."""
    whole = _CODE.sub(lambda found: found.group().replace(" ", _NO_BREAK), text)
    whole = re.sub(r"^( *-) ", rf"\1{_NO_BREAK}", whole)
    lines = fill(whole, 100, subsequent_indent=indent, break_long_words=False, break_on_hyphens=False)
    return lines.replace(_NO_BREAK, " ")


def _plain(text: str) -> str:
    return _ROLE.sub(r"`\1`", text).replace("``", "`").replace("::", ":")


def gaps(package: str) -> list[str]:
    """What the docstrings of a package's public names lack: one line for each array without a shape, or number without its unit."""
    found = []
    for entry in entries(package):
        if not entry.about:
            found.append(f"{entry.anchor}: no docstring")
        elif isinstance(entry.node, ast.FunctionDef):
            found += [f"{entry.anchor}: {gap}" for gap in _function_gaps(entry.node, "")]
        elif isinstance(entry.node, ast.ClassDef):
            found += [f"{entry.anchor}: {gap}" for gap in _class_gaps(entry.node)]
    return found


def _class_gaps(node: ast.ClassDef) -> Iterator[str]:
    about = ast.get_docstring(node) or ""
    yield from _unit_gaps(parsed(about))
    for member in _fields(node) if _is_dataclass(node) else ():
        name = _text(member.target)
        if name not in parsed(about).items and not name.startswith("_"):
            yield f"expected a description of {name}, found none"
        else:
            yield from _argument_gap(name, member.annotation, about)
    for function in node.body:
        if isinstance(function, ast.FunctionDef) and function.name == "__init__":
            yield from _function_gaps(function, about)
    for method in _methods(node):
        if not ast.get_docstring(method):
            yield f"{method.name} has no docstring"
        yield from (f"{method.name}: {gap}" for gap in _function_gaps(method, ""))


def _function_gaps(node: ast.FunctionDef, about: str) -> Iterator[str]:
    about = about or ast.get_docstring(node) or ""
    doc = parsed(about)
    if node.name != "__init__":
        yield from _unit_gaps(doc)
        outside = doc.text + " ".join(doc.sections.get("Returns", {}).values())
        if _is_array(node.returns) and not (_SHAPE.search(outside) or _REFERENCE.search(outside)):
            yield f"expected the shape of what it returns ({_text(node.returns)}), found none"
    for argument in [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]:
        yield from _argument_gap(argument.arg, argument.annotation, about)


def _argument_gap(name: str, annotation: ast.expr | None, about: str) -> Iterator[str]:
    doc = parsed(about)
    if not _is_array(annotation):
        return
    if doc.items and name not in doc.items:
        yield f"expected a description of {name}, found none"
    elif not (_SHAPE.search(doc.items.get(name, about)) or _REFERENCE.search(about)):
        yield f"expected the shape of {name} ({_text(annotation)}), found none"


def _unit_gaps(doc: Doc) -> Iterator[str]:
    for name, text in doc.items.items():
        unit = next((unit for ending, unit in _UNITS.items() if name.endswith(ending)), None)
        if unit is not None and not re.search(rf"\[{re.escape(unit)}[\] ]", text):
            yield f"expected the unit [{unit}] of {name}, found none"


def _is_array(annotation: ast.expr | None) -> bool:
    """Whether an annotation says that this is an array or may be one; a function of arrays is none."""
    text = _text(annotation)
    words = set(re.findall(r"\w+", text))
    return bool(words & _ARRAYS) and "Callable" not in words


def main() -> None:
    """Write the page."""
    write_atomically(PAGE, written())
    print(f"wrote {PAGE.relative_to(ROOT)}")


if __name__ == "__main__":
    main()
