"""Read launch files (YAML) and resolve them to a plan of processes."""

from __future__ import annotations

import importlib.util
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from advnerf_core.documents import Document, read_yaml
from advnerf_core.run_module import search_working_folder_last
from advnerf_core.strict import validate
from nodes.launching.launch_hosts import ALL_HOSTS, GATEWAY, choose_host
from nodes.launching.launch_schema import LaunchFile, NodeEntry, RecordEntry
from nodes.runtime.config import apply_overrides
from nodes.runtime.errors import ConfigError, TopicError
from nodes.runtime.named_code import with_absolute_code
from nodes.runtime.paths import bus_folder, shipped
from nodes.runtime.topics import status_topic

RECORDER = "recorder"
_REFERENCE = re.compile(r"\$\{([A-Za-z_][A-Za-z0-9_]*)\}")


@dataclass(frozen=True)
class Plan:
    """A launch file with includes, parameters and overrides applied.

    Attributes:
        file: The launch file.
        launch: The typed content.
        documents: Configuration of each enabled node with the places of its keys, for error messages.
        resolved: The complete launch as plain data, to be stored with the results.
        run_dir: Value of ``${run_dir}``.
        socket_dir: Value of ``${socket_dir}``.
    """

    file: Path
    launch: LaunchFile
    documents: dict[str, Document]
    resolved: dict[str, Any]
    run_dir: str
    socket_dir: str

    @property
    def nodes(self) -> dict[str, NodeEntry]:
        """The enabled nodes."""
        return {name: entry for name, entry in self.launch.nodes.items() if name in self.documents}


def load_launch(
    file: Path,
    overrides: Sequence[str] = (),
    run_dir: Path | str = "<run_dir>",
    host: str | None = None,
    twin_calibration: Path | str | None = None,
) -> Plan:
    """Read a launch file and resolve it.

    Args:
        file: A ``*.launch.yaml`` file.
        overrides: ``node.key=value`` for a node's configuration (``node.config.key`` where the key is also one of `NodeEntry`), ``params.name=value``, ``record=true``,
            ``hosts.name.key=value``, or ``keys=folder``.
        run_dir: Value of ``${run_dir}``.
        host: Host of the launch file that this computer is, or ``all``; None if the file has no hosts.
        twin_calibration: Value of ``${twin_calibration}``; None uses its place on this computer.
    """
    file = Path(file)
    document = _read_with_includes(file, ())
    if not isinstance(document.data, dict) or not isinstance(document.data.get("nodes"), dict):
        raise ConfigError(f"{document.place(())}: expected a launch file with keys name and nodes")
    for override in overrides:
        _apply_override(document, override)
    twin = shipped("calibration/twin") if twin_calibration is None else twin_calibration
    socket_dir = str(bus_folder(run_dir)) if isinstance(run_dir, Path) else "<socket_dir>"
    own = {"run_dir": str(run_dir), "socket_dir": socket_dir, "twin_calibration": str(twin)}
    params = {**(document.data.get("params") or {}), **own}
    document.data = with_absolute_code(_substitute(document.data, params, document, ()), file.parent)
    launch = validate(LaunchFile, document)
    if launch.record is not False:
        _add_recorder(document, launch, host)
        launch = validate(LaunchFile, document)
    choose_host(document, launch, host)
    launch = validate(LaunchFile, document)
    enabled = [name for name, entry in launch.nodes.items() if entry.enabled]
    for name in enabled:
        _check(name, launch.nodes[name], document)
    documents = {name: document.part(("nodes", name, "config")) for name in enabled}
    return Plan(file, launch, documents, document.data, str(run_dir), socket_dir)


def _read_with_includes(file: Path, above: tuple[Path, ...]) -> Document:
    file = file.resolve() if above else file
    if file.resolve() in above:
        raise ConfigError(
            f"{file}: includes itself through {' -> '.join(map(str, above))}; remove one of these includes"
        )
    document = read_yaml(file)
    if not isinstance(document.data, dict):
        raise ConfigError(f"{file}:1: expected a launch file with keys name and nodes")
    includes = document.data.pop("include", None) or []
    if not isinstance(includes, list) or not all(isinstance(entry, str) for entry in includes):
        raise ConfigError(
            f"{document.place(('include',))}: expected a list of launch files, got {includes!r:.80}"
        )
    base = Document({}, str(file))
    for entry in includes:
        included = _read_with_includes(file.parent / entry, (*above, file.resolve()))
        base.data = _merge(base.data, included.data)
        base.places |= included.places
    base.data = _merge(base.data, with_absolute_code(document.data, file.parent))
    base.places |= document.places
    return base


def _merge(below: Any, above: Any) -> Any:
    if isinstance(below, dict) and isinstance(above, dict):
        kinds = below.get("kind"), above.get("kind")
        # A section of another kind (of camera, of motion capture) has other keys, so it replaces the included one.
        if None not in kinds and kinds[0] != kinds[1]:
            return above
        return {**below, **{key: _merge(below.get(key), value) for key, value in above.items()}}
    return above


def _apply_override(document: Document, override: str) -> None:
    head = override.partition("=")[0].split(".")[0].strip()
    nodes = document.data["nodes"]
    if head in ("params", "record", "hosts", "keys", "operator"):
        known = document.data.get("params") or {}
        name = override.partition("=")[0].split(".", 1)[-1].strip()
        if head == "params" and name not in known:
            raise ConfigError(f"--set {override}: unknown parameter; known are {', '.join(known) or 'none'}")
        apply_overrides(document, [override])
    elif head in nodes:
        name, separator, value = override.partition("=")
        if "." not in name or not separator:
            raise ConfigError(f"--set {override}: expected NODE.KEY=VALUE")
        rest = name.split(".", 1)[1]
        prefix = (head,) if _is_about_the_process(rest, value, document, override) else (head, "config")
        apply_overrides(document, [f"{'.'.join((*prefix, rest))}={value}"], ("nodes",))
        key = ("nodes", *prefix, *rest.split("."))
        document.places[key] = f"--set {override}"
    else:
        hint = "; write NODE.KEY=VALUE, without nodes and config" if head == "nodes" else ""
        raise ConfigError(
            f"--set {override}: no node called {head!r}; known are {', '.join(nodes)}, and params{hint}"
        )


def _is_about_the_process(key: str, value: str, document: Document, override: str) -> bool:
    """Whether a key of ``--set NODE.KEY`` belongs to `NodeEntry`, such as ``if`` or ``config.rate_hz``, instead of the node's configuration."""
    if key.split(".")[0] not in {field.alias or name for name, field in NodeEntry.model_fields.items()}:
        return False
    hosts = document.data.get("hosts") or {}
    if key != "host":
        return True
    # Some nodes also have a key with this name: the address they listen on.
    if hosts and value.strip() not in hosts:
        node = override.split(".")[0].strip()
        raise ConfigError(
            f"--set {override}: expected the host that runs {node}, one of {', '.join(hosts)}; got {value.strip()}. "
            f"For the node's own key, use {node}.config.host"
        )
    return bool(hosts)


def _substitute(
    value: Any,
    params: dict[str, Any],
    document: Document,
    key: tuple[str | int, ...],
    above: tuple[str, ...] = (),
) -> Any:
    """Substitute parameters, whose values may use other parameters. ``above`` are the parameters being substituted."""
    if isinstance(value, dict):
        return {
            name: _substitute(item, params, document, (*key, name), above) for name, item in value.items()
        }
    if isinstance(value, list):
        return [_substitute(item, params, document, (*key, index), above) for index, item in enumerate(value)]
    if not isinstance(value, str):
        return value

    def lookup(name: str) -> Any:
        if name not in params:
            raise ConfigError(
                f"{document.place(key)}: unknown parameter ${{{name}}}; known are {', '.join(params)}"
            )
        if name in above:
            circle = " -> ".join((*above, name))
            raise ConfigError(
                f"{document.place(key)}: parameter {name} uses itself: {circle}; remove the cycle"
            )
        return _substitute(params[name], params, document, ("params", name), (*above, name))

    if whole := _REFERENCE.fullmatch(value):
        return lookup(whole[1])
    return _REFERENCE.sub(lambda match: str(lookup(match[1])), value)


def _add_recorder(document: Document, launch: LaunchFile, host: str | None) -> None:
    record = RecordEntry() if launch.record is True else launch.record
    assert isinstance(record, RecordEntry)
    if RECORDER in launch.nodes:
        raise ConfigError(
            f"{document.place(('nodes', RECORDER))}: expected either this node or the key record, got both; remove one of them"
        )
    others = [name for name, entry in launch.nodes.items() if entry.enabled]
    if launch.hosts and host != ALL_HOSTS:
        others.append(GATEWAY)  # which is added later, and alone says when the other host was silent
    attachments = [file for file in record.attachments if file]
    limits = record.model_dump(include={"max_bag_duration_s", "max_bag_size_mb"}, exclude_none=True)
    config = {
        "output": record.output,
        "topics": record.topics,
        "attachments": attachments,
        "statuses_of": others,
        **limits,
    }
    home = record.host or next((name for name, entry in launch.hosts.items() if entry.address is None), None)
    document.data["nodes"][RECORDER] = {
        "module": "nodes.recorder",
        "stop_last": True,
        "config": config,
        "host": home,
    }
    document.data["record"] = False
    document.places[("nodes", RECORDER)] = document.place(("record",))


def _check(name: str, entry: NodeEntry, document: Document) -> None:
    place = document.place(("nodes", name))
    try:
        status_topic(name)
    except TopicError as error:
        raise ConfigError(f"{place}: {error}") from None
    if name in ("params", "record", "hosts", "keys", "operator"):
        raise ConfigError(
            f"{place}: expected another node name than {name}, which --set uses; rename the node"
        )
    if entry.required and entry.respawn is not None:
        raise ConfigError(f"{place}: node {name} has respawn, so it must also have required: false")
    search_working_folder_last()  # as the node's process does
    try:
        found = importlib.util.find_spec(entry.module) is not None
    except ModuleNotFoundError:
        found = False
    if not found:
        raise ConfigError(
            f"{document.place(('nodes', name, 'module'))}: expected a Python module, found none called {entry.module}; correct the name"
        )
