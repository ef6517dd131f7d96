"""Every encoding against pixels laid out by hand, or against a formula that is not OpenCV's."""

import cv2
import numpy as np
import pytest

from nodes.runtime.errors import MessageError
from nodes.runtime.image_encodings import ENCODINGS
from nodes.runtime.messages import decode, encode, header, image_message, types
from nodes.runtime.pictures import rgb8_message, rgb_image

pytestmark = pytest.mark.live

RNG = np.random.default_rng(3)
COLOUR = (200, 90, 30)


def message(encoding, data, height, width, step=None, big=0):
    data = np.frombuffer(np.ascontiguousarray(data).tobytes(), np.uint8)
    image = types.Image(
        header=header(5, "cam"),
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=big,
        step=step or len(data) // height,
        data=data,
    )
    return decode("sensor_msgs/msg/Image", encode(image))


def pad(rows, count):
    """Rows of bytes with rubbish behind each."""
    rows = rows.reshape(rows.shape[0], -1)
    return np.hstack([rows, np.full((rows.shape[0], count), 170, np.uint8)])


ORDER = {
    "rgb": (0, 1, 2),
    "bgr": (2, 1, 0),
    "rgba": (0, 1, 2, 3),
    "bgra": (2, 1, 0, 3),
    "8UC3": (2, 1, 0),
    "8UC4": (2, 1, 0, 3),
}


@pytest.mark.parametrize("padding", [0, 5])
@pytest.mark.parametrize("name", ["rgb8", "bgr8", "rgba8", "bgra8", "8UC3", "8UC4"])
def test_eight_bit_colours(name, padding):
    rgba = RNG.integers(0, 256, (4, 6, 4), np.uint8)
    data = pad(rgba[..., ORDER[name if name.startswith("8UC") else name[:-1]]], padding)
    np.testing.assert_array_equal(rgb_image(message(name, data, 4, 6), "/c"), rgba[..., :3])


@pytest.mark.parametrize("big", [0, 1])
@pytest.mark.parametrize("padding", [0, 3])
@pytest.mark.parametrize("name", ["rgb16", "bgr16", "rgba16", "bgra16"])
def test_sixteen_bit_colours(name, padding, big):
    rgba = RNG.integers(0, 65536, (4, 6, 4)).astype(np.uint16)
    stored = np.ascontiguousarray(rgba[..., ORDER[name[:-2]]]).astype(">u2" if big else "<u2")
    data = pad(stored.view(np.uint8), padding)
    got = rgb_image(message(name, data, 4, 6, big=big), "/c")
    np.testing.assert_array_equal(got, np.rint(rgba[..., :3] * (255.0 / 65535.0)))


@pytest.mark.parametrize("name", ["mono8", "8UC1"])
def test_grey(name):
    grey = RNG.integers(0, 256, (3, 5), np.uint8)
    np.testing.assert_array_equal(
        rgb_image(message(name, pad(grey, 2), 3, 5), "/c"), np.stack([grey] * 3, axis=2)
    )


@pytest.mark.parametrize("big", [0, 1])
def test_grey_of_sixteen_bits(big):
    grey = np.array([[0, 256, 257, 32768, 65535]], np.uint16)
    data = grey.astype(">u2" if big else "<u2")
    assert rgb_image(message("mono16", data, 1, 5, big=big), "/c")[0, :, 1].tolist() == [0, 1, 1, 128, 255]


def limited_range(y, u, v):
    """ITU-R BT.601, studio range: the equations of the standard."""
    y, u, v = 1.164383 * (y - 16.0), u - 128.0, v - 128.0
    rgb = np.stack([y + 1.596027 * v, y - 0.391762 * u - 0.812968 * v, y + 2.017232 * u], axis=-1)
    return np.clip(np.rint(rgb), 0, 255)


@pytest.mark.parametrize(
    ("name", "layout"), [("uyvy", "uyvy"), ("yuv422", "uyvy"), ("yuyv", "yuyv"), ("yuv422_yuy2", "yuyv")]
)
def test_pairs_of_pixels_with_one_colour(name, layout):
    y = RNG.integers(16, 236, (4, 6)).astype(np.uint8)
    u, v = RNG.integers(60, 190, (2, 4, 3)).astype(np.uint8)
    order = {"uyvy": (u, y[:, ::2], v, y[:, 1::2]), "yuyv": (y[:, ::2], u, y[:, 1::2], v)}[layout]
    data = pad(np.stack(order, axis=-1), 4)
    expected = limited_range(y, np.repeat(u, 2, axis=1), np.repeat(v, 2, axis=1))
    assert np.abs(rgb_image(message(name, data, 4, 6), "/c") - expected).max() <= 1


@pytest.mark.parametrize("name", ["nv12", "nv21"])
def test_planes_of_grey_and_of_colours(name):
    y = RNG.integers(16, 236, (4, 6)).astype(np.uint8)
    u, v = RNG.integers(60, 190, (2, 2, 3)).astype(np.uint8)
    colours = np.stack((u, v) if name == "nv12" else (v, u), axis=-1).reshape(2, 6)
    data = pad(np.vstack([y, colours]), 2)
    expected = limited_range(y, *(np.repeat(np.repeat(c, 2, axis=0), 2, axis=1) for c in (u, v)))
    assert np.abs(rgb_image(message(name, data, 4, 6, step=8), "/c") - expected).max() <= 1


@pytest.mark.parametrize("bits", [8, 16])
@pytest.mark.parametrize("pattern", ["rggb", "bggr", "gbrg", "grbg"])
def test_bayer_patterns_are_named_by_their_corner(pattern, bits):
    """ROS and OpenCV give one pattern different names; a picture of one colour shows which was meant."""
    mosaic = np.zeros((8, 10), np.uint16)
    for index, letter in enumerate(pattern):
        mosaic[index // 2 :: 2, index % 2 :: 2] = COLOUR["rgb".index(letter)] * (257 if bits == 16 else 1)
    big = int(bits == 16)
    data = mosaic.astype(">u2") if big else mosaic.astype(np.uint8)
    got = rgb_image(message(f"bayer_{pattern}{bits}", pad(data.view(np.uint8), 3), 8, 10, big=big), "/c")
    assert (got == COLOUR).all()


def test_a_plain_picture_is_a_read_only_view():
    rgb = RNG.integers(0, 256, (7, 5, 3), np.uint8)
    data = encode(image_message(rgb, 99, "camera"))
    got = rgb_image(decode("sensor_msgs/msg/Image", data), "/c")
    np.testing.assert_array_equal(got, rgb)
    assert not got.flags.writeable
    assert np.shares_memory(got, np.frombuffer(data, np.uint8))


@pytest.mark.parametrize("encoding", ["32FC1", "16UC1", "nv24", "", "RGB8", "h264"])
def test_what_is_not_supported_is_named_with_what_is(encoding):
    with pytest.raises(MessageError) as caught:
        rgb_image(message(encoding, np.zeros((2, 4)), 2, 4), "/front/image in a.mcap")
    text = str(caught.value)
    assert text.startswith(
        f"/front/image in a.mcap: expected a supported image encoding, got {encoding!r}; supported are rgb8"
    )
    assert "\n" not in text
    assert all(name in text for name in ENCODINGS)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_data_that_do_not_fit_the_encoding_are_one_error(encoding):
    for height, width, step, size in [
        (4, 6, 60, 100),
        (4, 6, 1, 4),
        (0, 0, 0, 0),
        (5, 7, 80, 400),
        (1, 1, 8, 8),
    ]:
        try:
            got = rgb_image(message(encoding, np.zeros(size, np.uint8), max(height, 1), width, step), "/c")
            assert got.shape == (max(height, 1), width, 3)
        except MessageError as error:
            assert str(error).startswith("/c: ")  # noqa: PT017 - both are right, a traceback is not


def test_a_picture_becomes_rgb8_with_its_own_stamp():
    rgb = RNG.integers(0, 256, (4, 6, 3), np.uint8)
    got = rgb8_message(message("bgr8", rgb[..., ::-1], 4, 6), "/c")
    assert (got.encoding, got.header.frame_id, got.header.stamp.nanosec) == ("rgb8", "cam", 5)
    np.testing.assert_array_equal(rgb_image(got, "/c"), rgb)
    assert rgb8_message(got, "/c") is got
    with pytest.raises(
        MessageError, match=r"/c: expected sensor_msgs/msg/Image or .*, got std_msgs/msg/Header"
    ):
        rgb_image(got.header, "/c")


def compressed(form, pixels, kind=".png"):
    data = cv2.imencode(kind, pixels)[1].reshape(-1)
    return types.CompressedImage(header=header(5, "cam"), format=form, data=data)


@pytest.mark.parametrize(
    ("form", "order"),
    [
        ("png", 1),
        ("jpeg", 1),
        ("rgb8; png compressed bgr8", 1),
        ("bgr8; png compressed bgr8", 1),
        ("bgr8;png compressed bgr8", 1),
        ("bgr8; jpeg compressed bgr8", 1),
        ("rgb8; png compressed rgb8", -1),
        ("rgb8; png compressed ", -1),
        ("", 1),
    ],
)
def test_compressed_colours_by_what_image_transport_means(form, order):
    rgb = RNG.integers(0, 256, (8, 10, 3), np.uint8)
    got = rgb_image(compressed(form, np.ascontiguousarray(rgb[..., ::-1])), "/c")
    np.testing.assert_array_equal(got, rgb[..., ::order])


def test_compressed_grey_alpha_sixteen_bits_and_mosaics():
    rgba = RNG.integers(0, 256, (8, 10, 4), np.uint8)
    grey = np.ascontiguousarray(rgba[..., 0])
    np.testing.assert_array_equal(
        rgb_image(compressed("mono8; png compressed ", grey), "/c"), np.stack([grey] * 3, 2)
    )
    np.testing.assert_array_equal(
        rgb_image(compressed("png", np.ascontiguousarray(rgba[..., (2, 1, 0, 3)])), "/c"), rgba[..., :3]
    )
    deep = grey.astype(np.uint16) * 257
    np.testing.assert_array_equal(rgb_image(compressed("mono16; png compressed ", deep), "/c")[..., 1], grey)
    mosaic = np.zeros((8, 10), np.uint8)
    for index, letter in enumerate("rggb"):
        mosaic[index // 2 :: 2, index % 2 :: 2] = COLOUR["rgb".index(letter)]
    assert (rgb_image(compressed("bayer_rggb8; png compressed ", mosaic), "/c") == COLOUR).all()


def test_the_orientation_of_the_file_is_not_applied():
    """Pixels belong to the calibrated sensor: a tag that says how a person should hold the picture must not turn them."""
    data = cv2.imencode(".jpg", np.zeros((8, 16, 3), np.uint8))[1].tobytes()
    exif = b"Exif\0\0II*\0\x08\0\0\0\x01\0\x12\x01\x03\0\x01\0\0\0\x06\0\0\0\0\0\0\0"
    turned = data[:2] + b"\xff\xe1" + (len(exif) + 2).to_bytes(2, "big") + exif + data[2:]
    assert cv2.imdecode(np.frombuffer(turned, np.uint8), cv2.IMREAD_COLOR).shape == (16, 8, 3)
    message = types.CompressedImage(
        header=header(5, "cam"), format="jpeg", data=np.frombuffer(turned, np.uint8)
    )
    assert rgb_image(message, "/c").shape == (8, 16, 3)


@pytest.mark.parametrize("form", ["16UC1; compressedDepth png", "tiff", "h264"])
def test_compressed_data_of_another_kind_are_named(form):
    message = types.CompressedImage(header=header(5, "cam"), format=form, data=np.arange(99, dtype=np.uint8))
    with pytest.raises(
        MessageError, match=rf"/c: expected JPEG or PNG data, got the format '{form}' \(99 bytes\)"
    ):
        rgb_image(message, "/c")
