"""The part of Linux's video interface that we use: structures, request numbers, constants.

Source: ``linux/videodev2.h`` and ``linux/uvcvideo.h``; layouts apply to 64-bit machines (x86-64, aarch64), where a ``timeval``
is two 64-bit numbers. The tests compare sizes, offsets and numbers with those of a C compiler for these headers.
"""

from __future__ import annotations

import ctypes
from ctypes import Structure, Union, c_char, c_int32, c_int64, c_uint8, c_uint16, c_uint32, c_uint64

CAPTURE = 1  # V4L2_BUF_TYPE_VIDEO_CAPTURE
MEMORY_MMAP = 1
FIELD_NONE = 1
CAP_VIDEO_CAPTURE, CAP_VIDEO_CAPTURE_MPLANE = 0x1, 0x1000
CAP_META_CAPTURE, CAP_STREAMING, CAP_DEVICE_CAPS = 0x0080_0000, 0x0400_0000, 0x8000_0000
CAP_TIMEPERFRAME = 0x1000
BUF_FLAG_ERROR = 0x40
BUF_FLAG_TIMESTAMP_MASK, BUF_FLAG_TIMESTAMP_UNKNOWN = 0xE000, 0x0
BUF_FLAG_TSTAMP_SRC_MASK, BUF_FLAG_TSTAMP_SRC_SOE = 0x7_0000, 0x1_0000
CTRL_FLAG_DISABLED, CTRL_FLAG_READ_ONLY, CTRL_FLAG_INACTIVE = 0x1, 0x4, 0x10
QUANTIZATION_FULL_RANGE = 1
UVC_SET_CUR, UVC_GET_CUR, UVC_GET_LEN = 0x01, 0x81, 0x85

CONTROL_IDS = {
    "brightness": 0x0098_0900,
    "contrast": 0x0098_0901,
    "saturation": 0x0098_0902,
    "hue": 0x0098_0903,
    "auto_white_balance": 0x0098_090C,
    "gamma": 0x0098_0910,
    "auto_gain": 0x0098_0912,
    "gain": 0x0098_0913,
    "power_line_frequency": 0x0098_0918,
    "white_balance_temperature": 0x0098_091A,
    "sharpness": 0x0098_091B,
    "backlight_compensation": 0x0098_091C,
    "auto_exposure": 0x009A_0901,
    "exposure_absolute": 0x009A_0902,
    "exposure_auto_priority": 0x009A_0903,
    "focus_absolute": 0x009A_090A,
    "focus_auto": 0x009A_090C,
}
EXPOSURE_MANUAL = 1  # of the menu behind auto_exposure


class Capability(Structure):
    """``v4l2_capability``."""

    _fields_ = (
        ("driver", c_char * 16),
        ("card", c_char * 32),
        ("bus_info", c_char * 32),
        ("version", c_uint32),
        ("capabilities", c_uint32),
        ("device_caps", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class FormatDescription(Structure):
    """``v4l2_fmtdesc``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("flags", c_uint32),
        ("description", c_char * 32),
        ("pixelformat", c_uint32),
        ("mbus_code", c_uint32),
        ("reserved", c_uint32 * 3),
    )


class PixelFormat(Structure):
    """``v4l2_pix_format``."""

    _fields_ = (
        ("width", c_uint32),
        ("height", c_uint32),
        ("pixelformat", c_uint32),
        ("field", c_uint32),
        ("bytesperline", c_uint32),
        ("sizeimage", c_uint32),
        ("colorspace", c_uint32),
        ("priv", c_uint32),
        ("flags", c_uint32),
        ("ycbcr_enc", c_uint32),
        ("quantization", c_uint32),
        ("xfer_func", c_uint32),
    )


class _FormatUnion(Union):
    _fields_ = (("pix", PixelFormat), ("raw", c_uint8 * 200), ("align", c_uint64))


class Format(Structure):
    """``v4l2_format``."""

    _fields_ = (("type", c_uint32), ("fmt", _FormatUnion))


class Fraction(Structure):
    """``v4l2_fract``."""

    _fields_ = (("numerator", c_uint32), ("denominator", c_uint32))


class FrameSize(Structure):
    """``v4l2_frmsizeenum``; ``discrete`` is its first alternative, the others are not read."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("type", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("rest", c_uint32 * 4),
        ("reserved", c_uint32 * 2),
    )


class FrameInterval(Structure):
    """``v4l2_frmivalenum``; ``discrete`` is its first alternative, the others are not read."""

    _fields_ = (
        ("index", c_uint32),
        ("pixel_format", c_uint32),
        ("width", c_uint32),
        ("height", c_uint32),
        ("type", c_uint32),
        ("discrete", Fraction),
        ("rest", c_uint32 * 4),
        ("reserved", c_uint32 * 2),
    )


class _CaptureParameters(Structure):
    _fields_ = (
        ("capability", c_uint32),
        ("capturemode", c_uint32),
        ("timeperframe", Fraction),
        ("extendedmode", c_uint32),
        ("readbuffers", c_uint32),
        ("reserved", c_uint32 * 4),
    )


class _ParametersUnion(Union):
    _fields_ = (("capture", _CaptureParameters), ("raw", c_uint8 * 200))


class StreamParameters(Structure):
    """``v4l2_streamparm``."""

    _fields_ = (("type", c_uint32), ("parm", _ParametersUnion))


class RequestBuffers(Structure):
    """``v4l2_requestbuffers``."""

    _fields_ = (
        ("count", c_uint32),
        ("type", c_uint32),
        ("memory", c_uint32),
        ("capabilities", c_uint32),
        ("flags", c_uint8),
        ("reserved", c_uint8 * 3),
    )


class TimeValue(Structure):
    """``timeval``."""

    _fields_ = (("tv_sec", c_int64), ("tv_usec", c_int64))


class TimeCode(Structure):
    """``v4l2_timecode``."""

    _fields_ = (("type", c_uint32), ("flags", c_uint32), ("numbers", c_uint8 * 8))


class _MemoryUnion(Union):
    _fields_ = (("offset", c_uint32), ("userptr", c_uint64))


class Buffer(Structure):
    """``v4l2_buffer``."""

    _fields_ = (
        ("index", c_uint32),
        ("type", c_uint32),
        ("bytesused", c_uint32),
        ("flags", c_uint32),
        ("field", c_uint32),
        ("timestamp", TimeValue),
        ("timecode", TimeCode),
        ("sequence", c_uint32),
        ("memory", c_uint32),
        ("m", _MemoryUnion),
        ("length", c_uint32),
        ("reserved2", c_uint32),
        ("request_fd", c_int32),
    )


class Control(Structure):
    """``v4l2_control``."""

    _fields_ = (("id", c_uint32), ("value", c_int32))


class QueryControl(Structure):
    """``v4l2_queryctrl``."""

    _fields_ = (
        ("id", c_uint32),
        ("type", c_uint32),
        ("name", c_char * 32),
        ("minimum", c_int32),
        ("maximum", c_int32),
        ("step", c_int32),
        ("default_value", c_int32),
        ("flags", c_uint32),
        ("reserved", c_uint32 * 2),
    )


class ExtensionQuery(Structure):
    """``uvc_xu_control_query``."""

    _fields_ = (
        ("unit", c_uint8),
        ("selector", c_uint8),
        ("query", c_uint8),
        ("size", c_uint16),
        ("data", c_uint64),
    )


def _request(direction: int, group: str, number: int, size: int) -> int:
    """Request number as ``asm-generic/ioctl.h`` composes it."""
    return direction << 30 | size << 16 | ord(group) << 8 | number


def _both(number: int, structure: type[Structure], group: str = "V") -> int:
    return _request(3, group, number, ctypes.sizeof(structure))


QUERYCAP = _request(2, "V", 0, ctypes.sizeof(Capability))
ENUM_FMT, G_FMT, S_FMT = _both(2, FormatDescription), _both(4, Format), _both(5, Format)
REQBUFS, QUERYBUF = _both(8, RequestBuffers), _both(9, Buffer)
QBUF, DQBUF = _both(15, Buffer), _both(17, Buffer)
STREAMON, STREAMOFF = _request(1, "V", 18, 4), _request(1, "V", 19, 4)
G_PARM, S_PARM = _both(21, StreamParameters), _both(22, StreamParameters)
G_CTRL, S_CTRL, QUERYCTRL = _both(27, Control), _both(28, Control), _both(36, QueryControl)
ENUM_FRAMESIZES, ENUM_FRAMEINTERVALS = _both(74, FrameSize), _both(75, FrameInterval)
UVC_CTRL_QUERY = _both(0x21, ExtensionQuery, "u")


def fourcc(name: str) -> int:
    """Number of a four-letter pixel format such as ``YUYV``."""
    return int.from_bytes(name.encode("ascii").ljust(4), "little")


def fourcc_name(number: int) -> str:
    """Letters of a pixel format."""
    return int(number).to_bytes(4, "little").decode("ascii", "replace").rstrip(" \0")
