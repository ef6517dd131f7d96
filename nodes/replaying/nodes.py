"""Builds the nodes of a recorded launch for replay, with the configuration from the bag.

Files named in the configuration (calibration, attack) are taken from the bag's attachments, so that an old bag replays with the
original files on a machine that does not have those paths.
"""

from __future__ import annotations

import importlib
import inspect
import typing
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import ModuleType
from typing import Any

from pydantic import BaseModel

from advnerf_core.documents import Document, decode_text, dump_yaml, parse_yaml
from advnerf_core.errors import AdvnerfError
from advnerf_core.run_module import search_working_folder_last
from advnerf_core.strict import validate
from nodes.bags.reader import plain_name, read_attachments
from nodes.launching.launch_file import Plan, load_launch
from nodes.launching.launch_schema import NodeEntry
from nodes.runtime.clock import Clock
from nodes.runtime.errors import BagError, ConfigError
from nodes.runtime.node import Node, NodeContext
from nodes.runtime.paths import RESOLVED_NAME

# Modules that a bag may name. Other code runs only if the user names it.
_OUR_MODULES = "nodes."
_REPLAYABLE = "compositor, policy, counterfactual, safety, expert, calibration_drive, collect, or your own"


@dataclass(frozen=True)
class Choice:
    """Selection of nodes to replay.

    Attributes:
        nodes: Node names of the launch file, in the order in which they get a message.
        replacements: Module, or ``module:Class``, to use for a node, by the node's name.
        launch: Launch file to use instead of the one in the bag.
        overrides: ``node.key=value``, applied last.
    """

    nodes: tuple[str, ...]
    replacements: Mapping[str, str] = field(default_factory=dict)
    launch: Path | None = None
    overrides: tuple[str, ...] = ()


def build_nodes(bag: Path, choice: Choice, folder: Path, clock: Clock) -> dict[str, Node]:
    """Build the chosen nodes.

    Args:
        folder: Empty folder for the attachments of the bag, which must exist as long as the nodes.
        clock: The clock of the replay.
    """
    if not choice.nodes:
        raise BagError(
            "expected at least one node to replay, got none; name them, for example --nodes compositor,policy"
        )
    if unknown := [name for name in choice.replacements if name not in choice.nodes]:
        raise BagError(
            f"cannot replace {', '.join(unknown)}, which is not replayed; replayed are {', '.join(choice.nodes)}"
        )
    plan = _plan(bag, choice, folder)
    built: dict[str, Node] = {}
    try:
        for name in choice.nodes:
            context = NodeContext(name, folder, clock, lambda topic: 1)
            built[name] = _build(name, plan.nodes[name], plan.documents[name], choice, context)
    except BaseException:
        close_nodes(built)
        raise
    return built


def close_nodes(nodes: Mapping[str, Node]) -> None:
    """Close all nodes, even if one of them fails."""
    for node in nodes.values():
        try:
            node.close()
        finally:
            if node.inbox is not None:
                node.inbox.close()


def _plan(bag: Path, choice: Choice, folder: Path) -> Plan:
    modules = [f"{name}.module={spec.partition(':')[0]}" for name, spec in choice.replacements.items()]
    file = choice.launch or _launch_of_bag(bag, choice, folder)
    if choice.replacements or choice.launch:
        search_working_folder_last()  # as the processes of a launch do
    plan = load_launch(file, [*modules, *choice.overrides], folder)
    if missing := [name for name in choice.nodes if name not in plan.nodes]:
        raise BagError(f"{file} has no node {', '.join(missing)}; it has {', '.join(plan.nodes)}")
    return plan


def _launch_of_bag(bag: Path, choice: Choice, folder: Path) -> Path:
    """Write the launch file attached to a bag with the chosen nodes only. Its paths are replaced by the attachments' paths."""
    attachments = read_attachments(bag)
    if RESOLVED_NAME not in attachments:
        raise BagError(
            f"expected {RESOLVED_NAME} attached to {bag}, found none; give the launch file with --launch FILE"
        )
    source = f"{bag}:{RESOLVED_NAME}"
    data = parse_yaml(decode_text(attachments[RESOLVED_NAME], source), source).data
    nodes = data.get("nodes") if isinstance(data, dict) else None
    if not isinstance(nodes, dict):
        raise ConfigError(f"{source}: expected a launch file with keys name and nodes")
    if missing := [name for name in choice.nodes if name not in nodes]:
        raise BagError(f"{bag} was recorded without a node {', '.join(missing)}; it had {', '.join(nodes)}")
    for name in choice.nodes:
        module = str(nodes[name].get("module")) if isinstance(nodes[name], dict) else ""
        if not module.startswith(_OUR_MODULES) and name not in choice.replacements:
            raise BagError(
                f"{source}: {name} is {module!r}, code that is not part of advnerf; if you trust it, give --replace {name}={module}"
            )
    files = _put_down(bag, attachments, folder / "attachments")
    kept = {name: _found_again(nodes[name], files) for name in choice.nodes}
    text = dump_yaml({"name": str(data.get("name", "replay")), "nodes": kept})
    file = folder / RESOLVED_NAME
    file.write_text(text, encoding="utf-8")
    return file


def _put_down(bag: Path, attachments: Mapping[str, bytes], folder: Path) -> dict[str, str]:
    """Write the attachments to the folder. Returns their paths by name."""
    folder.mkdir()
    files = {name: folder / plain_name(bag, name) for name in attachments}
    for name, path in files.items():
        path.write_bytes(attachments[name])
    return {name: str(path) for name, path in files.items()}


def _found_again(value: Any, files: Mapping[str, str]) -> Any:
    """Replace file names in a configuration by the attachments with the same last part."""
    if isinstance(value, dict):
        return {key: _found_again(item, files) for key, item in value.items()}
    if isinstance(value, list):
        return [_found_again(item, files) for item in value]
    return files.get(value.rsplit("/", 1)[-1], value) if isinstance(value, str) else value


def _build(name: str, entry: NodeEntry, document: Document, choice: Choice, context: NodeContext) -> Node:
    spec = choice.replacements.get(name, entry.module)
    build, config_type = _builder(importlib.import_module(entry.module), spec.partition(":")[2])
    if opens := getattr(getattr(build, "__self__", None), "opens", ""):
        raise BagError(f"{name} cannot be replayed: it opens {opens}; replayable are {_REPLAYABLE}")
    if name in choice.replacements:
        document = _known_keys(document, config_type)
    try:
        node = build(validate(config_type, document), context)
    except (AdvnerfError, OSError, ValueError) as error:
        raise BagError(
            f"{name} cannot be built for replay: {error} (change its configuration with --set {name}.KEY=VALUE)"
        ) from error
    if node.inbox is not None or not node.publications:
        close_nodes({name: node})
        kind = "reads a device" if node.inbox is not None else "publishes nothing"
        raise BagError(f"{name} cannot be replayed: it {kind}; replayable are {_REPLAYABLE}")
    return node


def _known_keys(document: Document, config_type: type[BaseModel]) -> Document:
    """The keys of a recorded configuration that the replacing node knows. Unknown keys set by the user are an error."""
    if config_type.model_config.get("extra") != "forbid" or not isinstance(document.data, dict):
        return document
    data = {
        key: value
        for key, value in document.data.items()
        if key in config_type.model_fields or document.place((key,)).startswith("--set")
    }
    return Document(data, document.source, document.places)


def _builder(
    module: ModuleType, class_name: str
) -> tuple[Callable[[Any, NodeContext], Node], type[BaseModel]]:
    """Find the build function of a module's node, and the type of its configuration."""
    candidates: Sequence[Any]
    if class_name:
        candidates = [getattr(module, class_name, None)]
    elif callable(getattr(module, "build", None)):
        candidates = [module]
    else:
        own = [value for value in vars(module).values() if inspect.isclass(value) and issubclass(value, Node)]
        candidates = [
            value for value in own if value.__module__ == module.__name__ and hasattr(value, "build")
        ]
    build = getattr(candidates[0], "build", None) if len(candidates) == 1 else None
    if build is None:
        raise BagError(
            f"expected {module.__name__} to have one node class with build(config, context){', called ' + class_name if class_name else ''}; "
            "name it as module:Class"
        )
    hints = typing.get_type_hints(build)
    config_type = hints.get(next(iter(inspect.signature(build).parameters)))
    if not (inspect.isclass(config_type) and issubclass(config_type, BaseModel)):
        raise BagError(
            f"expected build() of {module.__name__} to annotate its configuration with a pydantic model; add the annotation"
        )
    return build, config_type
