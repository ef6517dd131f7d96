"""What several tests of cameras need."""

import pytest

ZED_CONF = """\
[LEFT_CAM_2K]
fx=1400.4
fy=1400.4
cx=1101.2
cy=620.7

[LEFT_CAM_VGA]
fx=350.1
fy=350.2
cx=334.6
cy=186.2
k1=-0.1737
k2=0.0276
p1=0.0003
p2=-0.0002
k3=0.0011

[RIGHT_CAM_VGA]
fx=351.0
fy=351.0
cx=340.0
cy=190.0
k1=-0.17
k2=0.025

[STEREO]
Baseline=119.9
CV_VGA=0.0012
"""


@pytest.fixture
def zed_conf(tmp_path):
    """A factory calibration file with the values of a usual ZED."""
    path = tmp_path / "SN12345.conf"
    path.write_text(ZED_CONF, encoding="utf-8")
    return path
