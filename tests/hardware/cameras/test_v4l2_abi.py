"""Structures and request numbers against what a C compiler makes of linux/videodev2.h on x86-64."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import pytest

from hardware.cameras.v4l2 import abi

pytestmark = pytest.mark.live

# Printed by a C program with sizeof, offsetof and the macros themselves.
SIZES = {
    "Capability": 104, "FormatDescription": 64, "Format": 208, "PixelFormat": 48, "RequestBuffers": 20, "Buffer": 88,
    "StreamParameters": 204, "Control": 8, "QueryControl": 68, "FrameSize": 44, "FrameInterval": 52, "ExtensionQuery": 16,
}  # fmt: skip
OFFSETS = {
    "Capability": {"card": 16, "bus_info": 48, "capabilities": 84, "device_caps": 88},
    "FormatDescription": {"description": 12, "pixelformat": 44},
    "Format": {"fmt": 8},
    "PixelFormat": {"pixelformat": 8, "bytesperline": 16, "sizeimage": 20, "quantization": 40},
    "Buffer": {
        "bytesused": 8,
        "flags": 12,
        "timestamp": 24,
        "sequence": 56,
        "memory": 60,
        "m": 64,
        "length": 72,
    },
    "StreamParameters": {"parm": 4},
    "QueryControl": {"minimum": 40, "flags": 56},
    "FrameSize": {"width": 12},
    "FrameInterval": {"type": 16, "discrete": 20},
    "ExtensionQuery": {"size": 4, "data": 8},
}
REQUESTS = {
    "QUERYCAP": 0x80685600, "ENUM_FMT": 0xC0405602, "G_FMT": 0xC0D05604, "S_FMT": 0xC0D05605, "REQBUFS": 0xC0145608,
    "QUERYBUF": 0xC0585609, "QBUF": 0xC058560F, "DQBUF": 0xC0585611, "STREAMON": 0x40045612, "STREAMOFF": 0x40045613,
    "G_PARM": 0xC0CC5615, "S_PARM": 0xC0CC5616, "G_CTRL": 0xC008561B, "S_CTRL": 0xC008561C, "QUERYCTRL": 0xC0445624,
    "ENUM_FRAMESIZES": 0xC02C564A, "ENUM_FRAMEINTERVALS": 0xC034564B, "UVC_CTRL_QUERY": 0xC0107521,
}  # fmt: skip
HEADERS = Path("/usr/include/linux/videodev2.h")
C_CONTROLS = {
    "brightness": "BRIGHTNESS", "contrast": "CONTRAST", "saturation": "SATURATION", "hue": "HUE",
    "auto_white_balance": "AUTO_WHITE_BALANCE", "gamma": "GAMMA", "auto_gain": "AUTOGAIN", "gain": "GAIN",
    "power_line_frequency": "POWER_LINE_FREQUENCY", "white_balance_temperature": "WHITE_BALANCE_TEMPERATURE",
    "sharpness": "SHARPNESS", "backlight_compensation": "BACKLIGHT_COMPENSATION", "auto_exposure": "EXPOSURE_AUTO",
    "exposure_absolute": "EXPOSURE_ABSOLUTE", "exposure_auto_priority": "EXPOSURE_AUTO_PRIORITY",
    "focus_absolute": "FOCUS_ABSOLUTE", "focus_auto": "FOCUS_AUTO",
}  # fmt: skip


def test_sizes_offsets_and_requests():
    assert {name: ctypes.sizeof(getattr(abi, name)) for name in SIZES} == SIZES
    for name, offsets in OFFSETS.items():
        assert {field: getattr(getattr(abi, name), field).offset for field in offsets} == offsets
    assert {name: getattr(abi, name) for name in REQUESTS} == REQUESTS


def test_pixel_format_letters():
    assert abi.fourcc("YUYV") == 0x56595559
    assert abi.fourcc_name(abi.fourcc("Y16")) == "Y16"


@pytest.mark.skipif(
    not (HEADERS.exists() and shutil.which("cc")), reason="needs a C compiler and the kernel's headers"
)
def test_constants_against_the_compiler(tmp_path):
    names = [f"V4L2_CID_{C_CONTROLS[name]}" for name in abi.CONTROL_IDS]
    names += [
        "V4L2_CAP_VIDEO_CAPTURE",
        "V4L2_CAP_VIDEO_CAPTURE_MPLANE",
        "V4L2_CAP_META_CAPTURE",
        "V4L2_CAP_STREAMING",
    ]
    names += [
        "V4L2_CAP_DEVICE_CAPS",
        "V4L2_BUF_FLAG_ERROR",
        "V4L2_CTRL_FLAG_DISABLED",
        "V4L2_EXPOSURE_MANUAL",
    ]
    lines = "".join(f'printf("%lu\\n", (unsigned long)({name}));' for name in names)
    source = f"#include <stdio.h>\n#include <linux/videodev2.h>\nint main(void) {{ {lines} return 0; }}"
    (tmp_path / "c.c").write_text(source)
    subprocess.run(["cc", "-o", tmp_path / "c", tmp_path / "c.c"], check=True)
    printed = subprocess.run([tmp_path / "c"], check=True, capture_output=True, text=True).stdout.split()
    ours = [
        *abi.CONTROL_IDS.values(),
        abi.CAP_VIDEO_CAPTURE,
        abi.CAP_VIDEO_CAPTURE_MPLANE,
        abi.CAP_META_CAPTURE,
    ]
    ours += [
        abi.CAP_STREAMING,
        abi.CAP_DEVICE_CAPS,
        abi.BUF_FLAG_ERROR,
        abi.CTRL_FLAG_DISABLED,
        abi.EXPOSURE_MANUAL,
    ]
    assert [int(value) for value in printed] == ours
