"""Configuration of the operator's page."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from pydantic import Field

from advnerf_core.strict import StrictModel


class PageConfig(StrictModel):
    """Configuration of the page node.

    Attributes:
        host: Address to listen on. Any address other than loopback is served with TLS, and asks for the one-time code that
            ``advnerf car page`` shows on this computer.
        port: TCP port; 0 selects a free one.
        names: Further names of this computer by which browsers may call it.
        role: ``operate``, or ``watch`` for a page that only shows the launch and can stop the car.
        room: Room calibration file with path, fence and start; empty for none.
        policy: The policy that drives, for the picture of what it sees. ``.safetensors`` and ``.onnx`` files tell.
        attacks: Attack files, and folders with attack files, to choose from.
        camera_topic: Topic of the camera's images.
        nodes: Nodes whose health is shown; none means all of the launch.
        picture_width_px: Largest width of a picture on the page [px].
        picture_quality: JPEG quality of the pictures, 1 to 100.
        hold_age_limit_s: Time without an answer of the operator's browser after which the button counts as released [s].
        picture_age_limit_s: Age of the picture on the operator's screen after which the button counts as released [s].
        lease_s: Time without an act after which another person may operate [s].
        code_s: Time for which a one-time code is valid [s].
        trial_ticks: Length of a trial in control ticks of 0.1 s.
    """

    host: str = "127.0.0.1"
    port: int = Field(default=8090, ge=0, le=65535)
    names: tuple[str, ...] = ()
    role: Literal["operate", "watch"] = "operate"
    room: Path | None = None
    policy: str = ""
    attacks: tuple[Path, ...] = ()
    camera_topic: Literal["/camera/image_raw", "/camera/image_raw/compressed"] = "/camera/image_raw"
    nodes: tuple[str, ...] | None = None
    picture_width_px: int = Field(default=480, ge=64, le=1920)
    picture_quality: int = Field(default=75, ge=10, le=95)
    hold_age_limit_s: float = Field(default=0.25, ge=0.1, le=0.25)
    picture_age_limit_s: float = Field(default=1.0, ge=0.3, le=5.0)
    lease_s: float = Field(default=120.0, ge=5.0)
    code_s: float = Field(default=300.0, ge=1.0)
    trial_ticks: int = Field(default=60, ge=1)
