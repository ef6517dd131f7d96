"""The architectures of policies that are trained here: a table of the built-in ones, and the users' own.

An architecture is a class derived from `advnerf_core.policies.network.SteeringNetwork`. A built-in one is a row of `ARCHITECTURES`; a
user's is an entry point of the group ``advnerf.architectures`` or ``file.py:Class``, see docs/policies.md.

Names and settings of the built-in ones are known without torch: their code is imported when a network is built.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Annotated, Any

from pydantic import BaseModel, Field, model_validator

from advnerf_core.code_files import modules_beside
from advnerf_core.errors import AdvnerfError
from advnerf_core.plugins import (
    FAILURES,
    PluginError,
    absolute_reference,
    code_sha256,
    is_file_reference,
    options_of,
    require_known,
    resolve,
)
from advnerf_core.policies.view import IMAGE_HEIGHT, IMAGE_WIDTH
from advnerf_core.strict import StrictModel, is_of_settings

if TYPE_CHECKING:
    from advnerf_core.policies.network import SteeringNetwork

GROUP = "advnerf.architectures"
PILOTNET = "pilotnet"
_WHAT = "architecture"

Width = Annotated[int, Field(ge=1, le=4096)]


class ArchitectureError(AdvnerfError, ValueError):
    """An architecture has no such setting, or its class cannot be used."""


class PilotNetConfiguration(StrictModel):
    """Settings of PilotNet."""

    hidden: tuple[Width, Width, Width] = Field(
        default=(100, 50, 10),
        description="Widths of the linear layers. The paper has 100, 50, 10; goal-conditioned networks are better with wider ones.",
    )


class ResNetConfiguration(StrictModel):
    """Settings of the residual network."""

    widths: tuple[Width, ...] = Field(
        default=(24, 32, 48, 64),
        min_length=1,
        max_length=5,
        description="Channels of the first convolution and of each residual stage. Each halves the image.",
    )
    blocks: int = Field(default=1, ge=1, le=8, description="Residual blocks of each stage.")
    hidden: Width = Field(default=64, description="Width of the linear layer before the output.")


class VisionTransformerConfiguration(StrictModel):
    """Settings of the vision transformer."""

    patch: tuple[int, int] = Field(
        default=(11, 10), description="Height and width of a patch [px]; they divide 66 and 200."
    )
    width: Width = Field(default=64, description="Length of a token; a multiple of 4 and of heads.")
    depth: int = Field(default=4, ge=1, le=24, description="Transformer blocks.")
    heads: int = Field(default=4, ge=1, le=64, description="Attention heads of each block.")

    @model_validator(mode="after")
    def _tiles_the_image(self) -> VisionTransformerConfiguration:
        height, width = self.patch
        if min(height, width) < 1 or IMAGE_HEIGHT % height or IMAGE_WIDTH % width:
            raise ValueError(
                f"expected a patch whose height divides {IMAGE_HEIGHT} and whose width divides {IMAGE_WIDTH}, such as 11, 10"
            )
        if self.width % self.heads or self.width % 4:
            raise ValueError("expected a width that is a multiple of 4 and of heads")
        return self


@dataclass(frozen=True)
class BuiltIn:
    """A row of the table of built-in architectures.

    Attributes:
        module: Module of `advnerf_core.policies` that holds the class.
        title: One line for lists.
    """

    module: str
    name: str
    title: str
    Configuration: type[BaseModel]

    def is_class(self, other: type[Any]) -> bool:
        """Whether a class is this architecture's; imports nothing."""
        return (other.__module__, other.__qualname__) == (
            f"advnerf_core.policies.{self.module}",
            self.name,
        )

    def load(self) -> type[SteeringNetwork]:
        """Load the class; imports torch."""
        found: type[SteeringNetwork] = getattr(
            import_module(f"advnerf_core.policies.{self.module}"), self.name
        )
        return found


ARCHITECTURES: Mapping[str, BuiltIn] = MappingProxyType(
    {
        PILOTNET: BuiltIn("pilotnet", "PilotNet", "PilotNet (Bojarski et al. 2016)", PilotNetConfiguration),
        "resnet": BuiltIn("resnet", "ResNet", "small residual network (He et al. 2016)", ResNetConfiguration),
        "vit_tiny": BuiltIn(
            "vit",
            "VisionTransformer",
            "small vision transformer (Dosovitskiy et al. 2021)",
            VisionTransformerConfiguration,
        ),
    }
)


@dataclass(frozen=True)
class Architecture:
    """An architecture with its settings, from which a network is built.

    Attributes:
        name: A built-in name, an entry point's name, or ``file.py:Class``; a relative file is relative to the working folder.
        configuration: The architecture's own settings, as the user wrote them; others have their defaults.
    """

    name: str = PILOTNET
    configuration: Mapping[str, Any] = field(default_factory=dict)

    def build(self, goal_size: int, max_steering_rad: float) -> SteeringNetwork:
        """A network with random weights, drawn from torch's global generator.

        Raises:
            PluginError: The architecture is unknown, or its code cannot be loaded.
            ArchitectureError: A wrong setting, or a class that cannot be used.
        """
        require_known(self.name, _WHAT, ARCHITECTURES, GROUP)
        code, files = code_sha256(self.name, ARCHITECTURES, GROUP), _code_files(self.name)
        made_by = load_architecture(self.name)
        configuration = _typed(made_by.Configuration, self.name, self.configuration)
        try:
            network = made_by(goal_size, max_steering_rad, configuration)
        except FAILURES as error:
            if self.name in ARCHITECTURES:
                raise
            raise ArchitectureError(
                f"{_WHAT} {self.name}: {made_by.__name__}({goal_size}, {max_steering_rad:g}, {configuration!r}) failed: "
                f"{type(error).__name__}: {error}"
            ) from error
        network.reference, network.code_sha256 = absolute_reference(self.name, Path.cwd()), code
        network.code_files = files
        return network

    def check(self) -> None:
        """Build a user's architecture and call it once, so that a mistake shows before hours of training. A built-in one needs no check.

        Raises:
            PluginError: The architecture is unknown, or its code cannot be loaded.
            ArchitectureError: A setting is wrong, or the call fails.
        """
        if self.name in ARCHITECTURES:
            return
        import torch

        with torch.random.fork_rng(devices=[]), torch.no_grad():
            network = self.build(2, 0.3).eval()
            if not any(each.requires_grad for each in network.parameters()):
                raise ArchitectureError(
                    f"{_WHAT} {self.name}: expected weights to train, got none; make layers in __init__, and assign them to self"
                )
            try:
                network(torch.rand(2, 3, IMAGE_HEIGHT, IMAGE_WIDTH), torch.eye(2))
            except FAILURES as error:
                raise ArchitectureError(
                    f"{_WHAT} {self.name}: a call with images [2, 3, {IMAGE_HEIGHT}, {IMAGE_WIDTH}] and goals [2, 2] failed: "
                    f"{type(error).__name__}: {error}"
                ) from error
            self._require_steady(network)
            self._require_all_stored(network)

    def _require_all_stored(self, network: SteeringNetwork) -> None:
        """Raise unless another network of this architecture answers as this one once it has its weights: files keep nothing else."""
        import torch

        other, images, goals = (
            self.build(2, 0.3).eval(),
            torch.rand(2, 3, IMAGE_HEIGHT, IMAGE_WIDTH),
            torch.eye(2),
        )
        other.load_state_dict(network.state_dict())
        expected, got = network(images, goals), other(images, goals)
        if not torch.allclose(expected, got, rtol=1e-4, atol=1e-6):
            raise ArchitectureError(
                f"{_WHAT} {self.name}: expected the same answers from a network that loads the weights of another, got "
                f"{float(got[0]):.4f} rad for {float(expected[0]):.4f} rad: what is not in state_dict() is neither trained nor stored; hold "
                "layers in torch.nn.ModuleList, and tensors in torch.nn.Parameter or register_buffer"
            )

    def _require_steady(self, network: SteeringNetwork) -> None:
        from advnerf_core.geometry import Pinhole
        from advnerf_core.policies.adapter import adapted
        from advnerf_core.policies.conformance import require_steady
        from advnerf_core.policies.contract import PolicyContract
        from advnerf_core.policies.view import PolicyView

        camera = Pinhole(
            IMAGE_WIDTH, IMAGE_HEIGHT, IMAGE_WIDTH, IMAGE_WIDTH, IMAGE_WIDTH / 2, IMAGE_HEIGHT / 2
        )
        view = PolicyView(camera, crop_top_px=0, crop_height_px=IMAGE_HEIGHT)
        require_steady(adapted(network, PolicyContract(view, goal_size=2)), f"{_WHAT} {self.name}")

    def described(self) -> dict[str, Any]:
        """Plain data that identifies the architecture on every machine; for a user's, the hash of its code and not the path of its file.

        PilotNet is described by its settings alone, as in existing files.
        """
        if self.name == PILOTNET:
            return plain_values(_typed(PilotNetConfiguration, self.name, self.configuration))
        if self.name in ARCHITECTURES:
            known = _typed(ARCHITECTURES[self.name].Configuration, self.name, self.configuration)
            return {"architecture": self.name, "configuration": plain_values(known)}
        return {
            "architecture": short_name(self.name),
            "configuration": dict(self.configuration),
            "code": code_sha256(self.name, ARCHITECTURES, GROUP),
        }


def load_architecture(reference: str) -> type[SteeringNetwork]:
    """The class that a reference names.

    Args:
        reference: A built-in name, an entry point's name, or ``file.py:Class``.

    Raises:
        PluginError: The architecture is unknown, its code cannot be loaded, or it is not a `SteeringNetwork`.
    """
    from advnerf_core.policies.network import SteeringNetwork

    built_in: dict[str, Callable[[], Any]] = {name: row.load for name, row in ARCHITECTURES.items()}
    found: Any = resolve(reference, _WHAT, built_in, GROUP)
    if not (isinstance(found, type) and issubclass(found, SteeringNetwork)):
        raise PluginError(
            f"{_WHAT} {reference}: expected a class derived from SteeringNetwork (advnerf_core/policies/network.py), "
            f"got {found!r:.80}; see docs/policies.md"
        )
    model = found.Configuration
    known = model is None or is_of_settings(model)
    if not (known and found.stateless):
        raise PluginError(
            f"{_WHAT} {reference}: expected stateless True and a Configuration that is a dataclass, a pydantic model or None, "
            f"got {found.stateless} and {model!r:.80}"
        )
    return found


def require_architecture(
    reference: str, folder: Path | None = None, configuration: Mapping[str, Any] | None = None
) -> None:
    """Raise unless a reference names an architecture, or for wrong settings of a built-in one; nothing is loaded.

    Args:
        folder: Folder that a relative ``file.py`` is relative to; the working folder if it is not given.

    Raises:
        PluginError: The architecture is unknown.
        ArchitectureError: A setting is unknown, or its value is wrong.
    """
    require_known(reference, _WHAT, ARCHITECTURES, GROUP, folder)
    if reference in ARCHITECTURES:
        _typed(ARCHITECTURES[reference].Configuration, reference, configuration or {})


def short_name(reference: str) -> str:
    """The name without folders: ``file.py:Class`` for ``folder/file.py:Class``."""
    return Path(reference).name if is_file_reference(reference) else reference


def plain_values(configuration: Any) -> dict[str, Any]:
    """All settings of a configuration as JSON values; empty if the architecture has none."""
    if configuration is None:
        return {}
    if isinstance(configuration, BaseModel):
        return configuration.model_dump(mode="json")
    return dataclasses.asdict(configuration)


def _code_files(reference: str) -> dict[str, bytes]:
    """Python files of ``file.py:Class`` by their path in the file's folder; empty for other references."""
    if not is_file_reference(reference):
        return {}
    file = Path(absolute_reference(reference, Path.cwd()).rpartition(":")[0])
    files = (file, *modules_beside(file))
    return {each.relative_to(file.parent).as_posix(): each.read_bytes() for each in files}


def _typed(model: type[Any] | None, name: str, configuration: Mapping[str, Any]) -> Any:
    what = f"setting of {short_name(name)}"
    return options_of(model, configuration, what, "configuration", ArchitectureError)
