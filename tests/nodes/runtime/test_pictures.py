"""Compressed pictures: what ROS would read, how true they are, and what strangers may send."""

import contextlib
import struct

import cv2
import numpy as np
import pytest

from nodes.runtime.errors import MessageError
from nodes.runtime.messages import decode, encode, image_message, ns_from_stamp
from nodes.runtime.pictures import compressed_image_message, jpeg_size, rgb8_message, rgb_image

pytestmark = pytest.mark.live

STAMP = 1_700_000_000_123_456_789
TYPE = "sensor_msgs/msg/CompressedImage"


def picture(height=188, width=336):
    rows, columns = np.mgrid[0:height, 0:width]
    return np.stack([rows % 256, columns * 255 // width, 200 - rows // 2], axis=2).astype(np.uint8)


def over_the_wire(message):
    return decode(message.__msgtype__, encode(message))


def test_picture_keeps_its_stamp_and_its_colours():
    rgb = picture()
    got = over_the_wire(compressed_image_message(rgb, STAMP, "camera", 90))
    assert got.format == "rgb8; jpeg compressed bgr8"
    assert len(got.data) < rgb.size / 8
    image = rgb8_message(got, "/c")
    assert (ns_from_stamp(image.header.stamp), image.header.frame_id, image.encoding) == (
        STAMP,
        "camera",
        "rgb8",
    )
    assert np.abs(rgb_image(got, "/c").astype(int) - rgb).mean() < 3.0
    # Anybody's JPEG decoder gives BGR of the same picture.
    assert np.abs(cv2.imdecode(got.data, cv2.IMREAD_COLOR)[:, :, ::-1].astype(int) - rgb).mean() < 3.0


def test_less_quality_is_less_data():
    sizes = [len(compressed_image_message(picture(), 0, "c", quality).data) for quality in (20, 60, 95)]
    assert sizes == sorted(sizes)


def test_a_raw_image_passes_as_it_is():
    image = image_message(picture(), STAMP, "camera")
    assert rgb8_message(image, "/c") is image
    np.testing.assert_array_equal(rgb_image(image, "/c"), picture())


@pytest.mark.parametrize("size", [(8, 8), (1, 1), (336, 188), (1921, 17)])
@pytest.mark.parametrize("progressive", [0, 1])
def test_size_is_read_from_the_header(size, progressive):
    pixels = np.zeros((size[1], size[0], 3), np.uint8)
    data = cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_PROGRESSIVE, progressive])[1].tobytes()
    assert jpeg_size(data) == size
    comment = b"\xff\xfe" + struct.pack(">H", 7) + b"hello"
    assert jpeg_size(data[:2] + b"\xff" + comment + data[2:]) == size


def bomb():
    data = bytearray(cv2.imencode(".jpg", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    start = data.index(b"\xff\xc0")
    data[start + 5 : start + 9] = struct.pack(">HH", 60000, 60000)
    return bytes(data)


def png_bomb():
    data = bytearray(cv2.imencode(".png", np.zeros((8, 8, 3), np.uint8))[1].tobytes())
    data[16:24] = struct.pack(">II", 60000, 60000)
    return bytes(data)


@pytest.mark.parametrize(
    ("data", "form", "message"),
    [
        (bomb(), "jpeg", "at most 16000000 pixels, got 60000 x 60000"),
        (b"", "jpeg", r"got the format 'jpeg' \(0 bytes\)"),
        (b"\xff\xd8\xff\xe0\x00\x00" + bytes(50), "jpeg", "without an image size"),
        (b"\x89PNG\r\n\x1a\n" + bytes(100), "png", "expected PNG data, got 108 bytes without an image size"),
        (png_bomb(), "png", "at most 16000000 pixels, got 60000 x 60000"),
        (bytes(100), "png", "got the format 'png'"),
    ],
)
def test_what_strangers_may_send(data, form, message):
    got = compressed_image_message(picture(8, 8), 0, "c")
    got.data, got.format = np.frombuffer(data, np.uint8), form
    with pytest.raises(MessageError, match=message):
        rgb_image(got, "/c")


def test_every_cut_and_every_flipped_byte_is_a_picture_or_one_error():
    good = compressed_image_message(picture(16, 24), 0, "c").data.tobytes()
    rng = np.random.default_rng(7)
    for k in range(400):
        data = bytearray(good[: rng.integers(0, len(good))] if k % 2 else good)
        if data:
            data[rng.integers(0, min(len(data), 700))] = rng.integers(0, 256)
        message = compressed_image_message(picture(8, 8), 0, "c")
        message.data = np.frombuffer(bytes(data), np.uint8)
        with contextlib.suppress(MessageError):
            assert rgb_image(message, "/c").ndim == 3


@pytest.mark.parametrize(
    ("rgb", "quality"),
    [(np.zeros((4, 4), np.uint8), 80), (np.zeros((4, 4, 3)), 80), (picture(8, 8), 0), (picture(8, 8), 101)],
)
def test_what_cannot_be_compressed(rgb, quality):
    with pytest.raises(MessageError, match="expected"):
        compressed_image_message(rgb, 0, "c", quality)
