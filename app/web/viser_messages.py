"""What a browser may say to viser: the few messages that its page needs here, with finite numbers of a
sensible size. All others are dropped: viser would open a public tunnel, or take a file, for anybody.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal

import msgspec
from msgspec import Meta

LARGEST = 64 * 1024

_Name = Annotated[str, Meta(max_length=300)]
_Id = Annotated[str, Meta(max_length=100)]
_Text = Annotated[str, Meta(max_length=2000)]
_Vector = tuple[float, float, float]
_Pixel = tuple[float, float]
_Pixels = Annotated[int, Meta(ge=0, le=100_000)]
_Index = Annotated[int, Meta(ge=0, le=2**31)] | None
_Modifier = _Id | None
_Value = bool | int | float | _Text | Annotated[list[bool | int | float | _Text], Meta(max_length=16)]


class _FromBrowser(msgspec.Struct, frozen=True, forbid_unknown_fields=True, tag_field="type"):
    """viser names the kind of a message in its field `type`."""


class _Camera(_FromBrowser, frozen=True, tag="ViewerCameraMessage"):
    wxyz: tuple[float, float, float, float]
    position: _Vector
    fov: float
    near: float
    far: float
    image_height: _Pixels
    image_width: _Pixels
    look_at: _Vector
    up_direction: _Vector


class _Pointer(_FromBrowser, frozen=True, tag="ScenePointerMessage"):
    event_type: Literal["click", "rect-select"]
    ray_origin: _Vector | None
    ray_direction: _Vector | None
    screen_pos: Annotated[list[_Pixel], Meta(max_length=8)]
    modifier: _Modifier = None


class _Click(_FromBrowser, frozen=True, tag="SceneNodeClickMessage"):
    name: _Name
    instance_index: _Index
    ray_origin: _Vector
    ray_direction: _Vector
    screen_pos: _Pixel
    modifier: _Modifier = None
    owner: _Name = ""


class _Drag(_FromBrowser, frozen=True, tag="SceneNodeDragMessage"):
    phase: Literal["start", "update", "end"]
    name: _Name
    instance_index: _Index
    start_position: _Vector
    start_screen_pos: _Pixel
    end_position: _Vector
    end_screen_pos: _Pixel
    button: Literal["left", "middle", "right"]
    modifier: _Modifier = None
    owner: _Name = ""


class _Controls(_FromBrowser, frozen=True, tag="TransformControlsUpdateMessage"):
    name: _Name
    wxyz: tuple[float, float, float, float]
    position: _Vector
    owner: _Name = ""


class _ControlsStart(_FromBrowser, frozen=True, tag="TransformControlsDragStartMessage"):
    name: _Name
    owner: _Name = ""


class _ControlsEnd(_FromBrowser, frozen=True, tag="TransformControlsDragEndMessage"):
    name: _Name
    owner: _Name = ""


class _Updates(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Only the value of a control may be changed, not how it looks or what it shows."""

    value: _Value


class _Gui(_FromBrowser, frozen=True, tag="GuiUpdateMessage"):
    uuid: _Id
    updates: _Updates


class _Command(_FromBrowser, frozen=True, tag="CommandTriggerMessage"):
    uuid: _Id


_Allowed = _Camera | _Pointer | _Click | _Drag | _Controls | _ControlsStart | _ControlsEnd | _Gui | _Command
_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(_Allowed)
# A camera is a browser's own; all else is everybody's.
_viewers_decoder: msgspec.msgpack.Decoder[Any] = msgspec.msgpack.Decoder(_Camera)


def is_allowed(message: bytes, *, looks_only: bool = False) -> bool:
    """Whether a browser, or one that may look and not touch, may send this to viser."""
    if len(message) > LARGEST:
        return False
    try:
        decoded = (_viewers_decoder if looks_only else _decoder).decode(message)
    except (msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
        return False
    return _is_finite(msgspec.to_builtins(decoded))


def _is_finite(value: object) -> bool:
    if isinstance(value, float):
        return math.isfinite(value)
    if isinstance(value, dict):
        return all(map(_is_finite, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_is_finite, value))
    return True
