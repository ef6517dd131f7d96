from fractions import Fraction

import av
import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.keyframes import MOVEMENT, KeyframeSelector, sharpness, work_image
from advnerf_core.data.video import keep_keyframes, read_video

WIDTH, HEIGHT = 320, 240
RNG = np.random.default_rng(4)


def wall(width=2000):
    """A long picture with corners to follow: rectangles of random colours."""
    image = np.full((HEIGHT, width, 3), 128, np.uint8)
    for _ in range(width // 3):
        x, y = RNG.integers(0, width), RNG.integers(0, HEIGHT)
        w, h = RNG.integers(8, 40, 2)
        image[y : y + h, x : x + w] = RNG.integers(0, 255, 3)
    return image


WALL = wall()


def frame_at(offset_px, blurred=False):
    frame = WALL[:, round(offset_px) : round(offset_px) + WIDTH]
    return cv2.GaussianBlur(frame, (0, 0), 4.0) if blurred else np.ascontiguousarray(frame)


def choose(offsets, blurred=(), movement=MOVEMENT, rate_hz=30.0):
    selector, kept = KeyframeSelector(movement), []
    for number, offset in enumerate(offsets):
        chosen = selector.offer(number, number / rate_hz, frame_at(offset, number in blurred))
        kept += [] if chosen is None else [chosen.number]
    last = selector.last()
    return kept + ([] if last is None else [last.number])


def test_movement_is_the_displacement_of_the_picture():
    selector = KeyframeSelector()
    selector.offer(0, 0.0, frame_at(100))
    assert selector.movement(work_image(frame_at(116))) == pytest.approx(16 / WIDTH, abs=0.002)
    assert selector.movement(work_image(frame_at(100))) == pytest.approx(0.0, abs=1e-4)
    assert selector.movement(work_image(frame_at(1500))) > 0.2, "another view"


def test_frames_come_at_steps_of_the_movement():
    kept = choose(2.0 * np.arange(150), movement=0.1)  # 32 px, looked for from 19 px on
    steps = 2.0 * np.diff(kept[:-1])
    assert len(kept) > 8
    assert (steps >= 18).all()
    assert (steps <= 34).all()


def test_a_camera_that_stands_still_gives_one_frame():
    assert len(choose(np.zeros(100))) == 1


def test_twice_the_speed_gives_the_same_number_of_frames_for_the_same_way():
    slow, fast = choose(np.linspace(0, 400, 160)), choose(np.linspace(0, 400, 80))
    assert len(slow) == pytest.approx(len(fast), rel=0.2)


def test_blurred_frames_are_passed_over_for_sharp_neighbours():
    blurred = {number for number in range(120) if number % 3 != 0}
    kept = choose(2.0 * np.arange(120), blurred=blurred, movement=0.1)
    assert len(kept) > 5
    assert not blurred & set(kept)


def test_sharpness_of_a_known_picture():
    grey = np.zeros((6, 6), np.uint8)
    grey[2, 3] = 10
    # The 4-neighbour Laplacian of one dot: -40 there and 10 at four neighbours; their sum is 0.
    assert sharpness(grey) == pytest.approx((40**2 + 4 * 10**2) / 36)


def encode(path, frames, rate=30, rotation=None):
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.width, stream.height, stream.pix_fmt = frames[0].shape[1], frames[0].shape[0], "yuv420p"
        stream.options = {"crf": "10"}
        for image in frames:
            for packet in stream.encode(av.VideoFrame.from_ndarray(image, format="rgb24")):
                container.mux(packet)
        for packet in stream.encode():
            container.mux(packet)
    return path


def test_a_video_becomes_files_and_a_second_run_uses_them_again(tmp_path):
    video = encode(tmp_path / "walk.mp4", [frame_at(4 * k) for k in range(60)])
    seen = list(read_video(video))
    assert len(seen) == 60
    assert [row[1] for row in seen[:3]] == pytest.approx([0.0, 1 / 30, 2 / 30], abs=1e-3)
    assert np.abs(seen[40][3].astype(int) - frame_at(160)).mean() < 6.0
    reports = []
    files = keep_keyframes(video, tmp_path / "kept", 0.1, 100, lambda share, text: reports.append(share))
    assert 6 <= len(files) <= 13
    assert sorted(files) == files
    assert reports[-1] > 0.9
    stamps = [file.stat().st_mtime_ns for file in files]
    assert (
        keep_keyframes(video, tmp_path / "kept", 0.1, 100, lambda share, text: pytest.fail("worked again"))
        == files
    )
    assert [file.stat().st_mtime_ns for file in files] == stamps
    few = keep_keyframes(video, tmp_path / "kept", 0.1, 5, lambda share, text: None)
    assert len(few) == 5
    assert sorted((tmp_path / "kept").glob("*.jpg")) == few


def test_what_is_no_video_is_one_error(tmp_path):
    (tmp_path / "a.mp4").write_bytes(b"not a video at all")
    with pytest.raises(DatasetError, match=r"video that can be decoded, got .*a\.mp4"):
        list(read_video(tmp_path / "a.mp4"))
    with pytest.raises(DatasetError, match=r"nowhere\.mp4"):
        keep_keyframes(tmp_path / "nowhere.mp4", tmp_path / "k", MOVEMENT, 5, lambda share, text: None)


def test_a_video_that_was_cut_off_gives_what_it_has(tmp_path):
    video = encode(tmp_path / "cut.mkv", [frame_at(4 * k) for k in range(60)])
    data = video.read_bytes()
    video.write_bytes(data[: len(data) * 2 // 3])
    assert 10 < len(list(read_video(video))) < 60


@pytest.mark.parametrize(
    ("aspect", "size"),
    [((1, 1), (144, 108)), ((4, 3), (192, 108)), ((3, 4), (144, 144)), ((0, 1), (144, 108))],
)
def test_frames_have_square_pixels_whatever_the_video_stores(tmp_path, aspect, size):
    path, left = tmp_path / "a.mp4", np.zeros((108, 144, 3), np.uint8)
    left[:, :72] = 200
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=10)
        stream.width, stream.height, stream.pix_fmt = 144, 108, "yuv420p"
        stream.codec_context.sample_aspect_ratio = Fraction(*aspect)
        container.mux(stream.encode(av.VideoFrame.from_ndarray(left, format="rgb24")))
        container.mux(stream.encode())
    ((_, _, _, rgb),) = read_video(path)
    assert rgb.shape == (size[1], size[0], 3)
    columns = rgb.mean(axis=(0, 2))
    assert abs(int((columns > 100).sum()) - size[0] // 2) <= 2, "stretched, not padded"
