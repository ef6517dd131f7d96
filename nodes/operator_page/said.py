"""Messages from the page to the node, checked before anything acts on them."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import (
    BeforeValidator,
    ConfigDict,
    Field,
    StringConstraints,
    TypeAdapter,
    ValidationError,
)

from advnerf_core.strict import StrictModel
from nodes.runtime.errors import MessageError

LONGEST_BYTES = 2048
# No control characters, and none that reverse the text after them: a line of the log shows what was typed, in its order.
_PRINTED = r"^[^\p{Cc}\p{Zl}\p{Zp}\u{061c}\u{200e}\u{200f}\u{202a}-\u{202e}\u{2066}-\u{2069}]+$"
_Name = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=40, pattern=_PRINTED)
]
_Text = Annotated[
    str, StringConstraints(strip_whitespace=True, min_length=1, max_length=200, pattern=_PRINTED)
]
_Count = Annotated[int, Field(ge=0, lt=2**53, strict=True)]
# A capture stamp in nanoseconds needs more digits than a number of JavaScript has, so it is sent as text.
_Stamp = Annotated[str, StringConstraints(pattern=r"^(0|[1-9][0-9]{0,18})$")]


STOPS = ("estop", "disarm")


def _count_or_zero(value: Any) -> int:
    return value if type(value) is int and 0 <= value < 2**53 else 0


def _stamp_or_zero(value: Any) -> str:
    return (
        value if isinstance(value, str) and value.isascii() and value.isdigit() and len(value) < 20 else "0"
    )


class Entry(StrictModel):
    """The one-time code, and the name of the person who enters it; empty for none."""

    code: Annotated[str, StringConstraints(max_length=64, pattern=r"^[\x00-\x7f]+$")]
    name: _Name | Literal[""] = ""


class PictureSeen(StrictModel):
    """A picture was drawn on the screen, or could not be decoded."""

    t: Literal["seen"]
    c: Annotated[int, Field(ge=0, le=2, strict=True)]
    s: _Stamp


class Wants(StrictModel):
    """The pictures that the page shows."""

    t: Literal["wants"]
    c: Annotated[list[Annotated[int, Field(ge=0, le=2, strict=True)]], Field(max_length=3)]


class _Act(StrictModel):
    """An act carries the key of its connection, a number that grows, and the newest picture that its operator saw."""

    key: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{32}$")]
    n: _Count
    frame: _Stamp


class Hold(_Act):
    """The answer to a beat while the button is held."""

    t: Literal["hold"]
    beat: _Count
    press: Annotated[int, Field(ge=1, lt=2**53, strict=True)]


class Release(_Act):
    """The button was released."""

    t: Literal["release"]
    press: Annotated[int, Field(ge=1, lt=2**53, strict=True)]


class Take(_Act):
    """Ask for the desk."""

    t: Literal["take"]
    name: _Name


class Stop(StrictModel):
    """Stop the car. Only the kind matters: a wrong or missing number, picture or key refuses no stop."""

    model_config = ConfigDict(extra="ignore", frozen=True)

    t: Literal["estop", "disarm"]
    n: Annotated[int, BeforeValidator(_count_or_zero)] = 0
    frame: Annotated[str, BeforeValidator(_stamp_or_zero)] = "0"


class Plain(_Act):
    """An act without arguments."""

    t: Literal["leave", "reset_estop", "trial", "trial_end", "attack_off", "record", "record_stop"]


class ChooseAttack(_Act):
    """Show an attack of the catalogue."""

    t: Literal["attack"]
    id: Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{12}$")]


class Label(_Act):
    """Label an event in the bag."""

    t: Literal["label"]
    text: _Text


Act = Hold | Release | Take | Plain | Stop | ChooseAttack | Label
Said = PictureSeen | Wants | Act
_ADAPTER: TypeAdapter[Said] = TypeAdapter(Annotated[Said, Field(discriminator="t")])


def read_said(data: str | bytes) -> Said:
    """Read one message.

    Raises:
        MessageError: The message is too long, is not JSON, or has a wrong field.
    """
    if isinstance(data, bytes) or len(data) > LONGEST_BYTES:
        raise MessageError(f"expected text of at most {LONGEST_BYTES} characters, got {len(data)}")
    try:
        return _ADAPTER.validate_json(data)
    except ValidationError as error:
        first = error.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "the message"
        raise MessageError(f"expected a message of the page: {where}: {first['msg']}") from None


def read_entry(data: bytes) -> Entry | None:
    """Read what a browser sends to get a session; None for anything else."""
    if len(data) > LONGEST_BYTES:
        return None
    try:
        return Entry.model_validate_json(data)
    except ValidationError:
        return None
