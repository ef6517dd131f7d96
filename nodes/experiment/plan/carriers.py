"""The section ``carrier`` of an experiment: how a texture is shown in the deployed drive, and in the training frames of victims."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from pydantic import Field, model_validator

from advnerf_core.strict import StrictModel
from nodes.experiment.plan.numbers import Unit

Way = Literal["composed", "native"]


class _FaceCarrier(StrictModel):
    """One flat texture on a panel of the world. The space ``colours`` searches it, and nothing else is attacked."""

    searched: ClassVar[str] = "The texture of one face is searched in the learned scene"
    training: ClassVar[None] = None
    response: ClassVar[Literal["identity"]] = "identity"

    resolution: Annotated[int, Field(ge=2, le=128)] = Field(
        default=64, description="Grid cells along each side of the face."
    )
    plain_rgb: tuple[Unit, Unit, Unit] = Field(
        default=(0.20, 0.62, 0.28), description="Colour of the face without an attack."
    )


class OverlayConfig(_FaceCarrier):
    """The face is drawn into the camera's images where its panel is, as the live compositor does."""

    kind: Literal["overlay"]
    panel: str = Field(
        default="board", min_length=1, description="Which of the world's panels carries the face."
    )


class ScreenConfig(_FaceCarrier):
    """A screen of the world shows the face; it shows ``plain_rgb`` while the world is photographed."""

    kind: Literal["screen"]
    panel: str = Field(
        default="monitor", min_length=1, description="Which of the world's screens shows the face."
    )
    display_model: bool = Field(
        default=True,
        description="Search with the screen's measured colours in the loop; false takes it for ideal.",
    )


class _ObjectCarrier(StrictModel):
    """The objects of the section ``objects``."""

    training: Way
    response: Literal["identity", "measured"] = Field(
        default="identity",
        description="How the learned scene shows a panel: in its own colours, or as the driving camera saw plain colours on it while the "
        "world was photographed.",
    )

    @model_validator(mode="after")
    def _measured_where_it_is_seen(self) -> _ObjectCarrier:
        if self.response == "measured" and self.training != "native":
            raise ValueError(
                f"expected carrier.training native with carrier.response measured, as victims must see the light that searches see, got {self.training}"
            )
        return self


class ComposedConfig(_ObjectCarrier):
    """Objects are drawn into the deployed pictures by depth."""

    kind: Literal["composed"]
    training: Way = Field(
        default="composed",
        description="How frames of the deployment scene show the objects while victims learn.",
    )


class NativeConfig(_ObjectCarrier):
    """Objects stand in the world's own scene, which lights and hides them."""

    kind: Literal["native"]
    training: Way = Field(
        default="native",
        description="How frames of the deployment scene show the objects while victims learn.",
    )


FaceCarrier = OverlayConfig | ScreenConfig
CarrierConfig = Annotated[
    OverlayConfig | ScreenConfig | ComposedConfig | NativeConfig, Field(discriminator="kind")
]
