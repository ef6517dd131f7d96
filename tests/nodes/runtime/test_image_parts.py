import numpy as np
import pytest

from nodes.runtime.bus import Bus
from nodes.runtime.errors import MessageError
from nodes.runtime.image_parts import join_image, split_image
from nodes.runtime.messages import decode, encode, image_message
from nodes.runtime.messages import stamp_ns as stamp_of
from nodes.runtime.pictures import rgb_image

pytestmark = pytest.mark.live

PIXELS = np.random.default_rng(1).integers(0, 256, (188, 366, 3), dtype=np.uint8)


@pytest.mark.parametrize("frame_id", ["", "a", "camera", "camera_optical_frame"])
def test_parts_joined_are_the_bytes_of_the_codec(frame_id):
    for stamp_ns in (0, 1_700_000_000_123_456_789):
        message = image_message(PIXELS, stamp_ns, frame_id)
        prefix, pixels = split_image(message)
        assert prefix + bytes(pixels) == encode(message)
        back = join_image(prefix, bytes(pixels))
        assert vars(back).keys() == vars(message).keys()
        assert stamp_of(back) == stamp_ns
        assert back.header.frame_id == frame_id
        np.testing.assert_array_equal(rgb_image(back, "test"), PIXELS)
        assert not back.data.flags.writeable


def test_small_and_strided_images_stay_in_one_piece():
    assert split_image(image_message(PIXELS[:10, :10], 0, "c")) is None
    message = image_message(PIXELS, 0, "c")
    message.data = message.data[::2]
    assert split_image(message) is None


def test_parts_that_do_not_belong_together_are_refused():
    prefix, pixels = split_image(image_message(PIXELS, 0, "c"))
    for parts in (
        (prefix, bytes(pixels)[:-1]),
        (prefix[:8], bytes(pixels)),
        (b"", b""),
        (prefix[4:], bytes(pixels)),
    ):
        with pytest.raises(MessageError):
            join_image(*parts)


def test_over_the_bus_images_are_views_and_recorders_get_the_same_bytes(tmp_path):
    message = image_message(PIXELS, 42, "camera")
    with Bus(tmp_path) as sender, Bus(tmp_path) as receiver:
        receiver.subscribe("/camera/image_raw")
        sender.publisher("/camera/image_raw")
        sender.wait_for_subscribers(["/camera/image_raw"], 60.0)
        sender.publish("/camera/image_raw", message)
        receiver.wait(1.0)
        (got,) = receiver.receive()
        np.testing.assert_array_equal(rgb_image(got.message(), "test"), PIXELS)
        assert got.info.raw == encode(message)
        assert stamp_of(decode("sensor_msgs/msg/Image", got.info.raw)) == 42
