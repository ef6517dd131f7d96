"""Requests to the attack commands and the attack node: an experiment with one victim in a learned scene of the user's own, and no stages.

The same text goes to the node and into the folder of a search: paths in it are absolute. Needs no torch.
"""

from __future__ import annotations

from pathlib import Path

from advnerf_core.documents import dump_yaml, parse_yaml
from advnerf_core.strict import validate
from nodes.experiment.plan.config import ExperimentConfig
from nodes.lab.located import READ_AGAIN
from nodes.lab.worlds.named import NamedWorld, read_world
from nodes.runtime.errors import ConfigError


def require_request(config: ExperimentConfig, source: str) -> None:
    """Refuse an experiment of several searches, or one that needs stages.

    Raises:
        ConfigError: The experiment has several searches or needs stages; ``source`` is its name in the message.
    """
    over = config.over
    wanted = {
        "world {kind: scene, file: ...}, a learned scene of your own": config.own_scene,
        "one victim that exists ({policy: ...})": len(config.attacked) == 1 and not config.trained,
        "one path": len(config.cell_paths) == 1,
        "one method of attack in over.method": len(config.over.method) == len(config.methods) == 1,
        "no variants": not (over.variant or over.model_extra),
    }
    for what, is_so in wanted.items():
        if not is_so:
            raise ConfigError(
                f"{source}: expected {what}, got another experiment; run it with 'advnerf experiment run'"
            )


def as_text(config: ExperimentConfig, world: NamedWorld) -> str:
    """YAML text from which the same experiment is read on the same machine, wherever the text is stored."""
    data = config.model_dump(mode="json", context=READ_AGAIN, exclude_unset=True)
    section = world.config.model_dump(mode="json", context=READ_AGAIN, exclude_unset=True)
    data = {"name": config.name, "world": {"kind": world.kind, **section}} | {
        key: value for key, value in data.items() if key != "world"
    }
    return dump_yaml(data, default_flow_style=None, width=120)


def parse_request(text: str, source: str = "request", folder: Path | None = None) -> str:
    """Check the text of a request; returns it as the folder of its search stores it.

    Args:
        source: Name of the text in messages.
        folder: Folder that its paths are relative to; None for the working folder.

    Raises:
        ConfigError: The text has an error, which is reported with its line and the valid keys.
    """
    document, here = parse_yaml(text, source), folder or Path.cwd()
    config = validate(ExperimentConfig, document, here)
    require_request(config, source)
    return as_text(config, read_world(document.part(("world",)), here))
