"""Foreign logs, error figures against numpy, saliency of a network whose gradient is known, training that resumes."""

import contextlib
import os
from pathlib import Path
from types import SimpleNamespace

import av
import cv2
import numpy as np
import pytest
import torch
import yaml

from advnerf_core.data.logs.choice import LogChoice, LogError
from advnerf_core.driving.expert import Expert
from advnerf_core.driving.path import Path as DrivingPath
from advnerf_core.geometry import Pinhole
from advnerf_core.learning.frames import Frames
from advnerf_core.learning.recipe import ImitationConfig
from advnerf_core.policies.policy_file import load_policy
from advnerf_core.policies.view import PolicyView
from calibration.schema import CameraCalibration, RoomCalibration, load_calibration, save_calibration
from nodes.lab.policy_data import train as training
from nodes.lab.policy_data.evaluate import compare, predict, saliency, write_saliency
from nodes.lab.policy_data.frames import frames_of, view_for_size, view_of
from nodes.lab.policy_data.logs import OpenLog, open_log
from nodes.lab.policy_data.recordings import crop_notes, policy_view, recorded_frames, room_of
from nodes.runtime.errors import ConfigError

CHOICE = LogChoice("frame", "angle", 0.5, "right")
TWIN_CAMERA = Path(__file__).parents[3] / "calibration/twin/camera.yaml"
EXPERT = Expert(DrivingPath.rounded_square(4.0, 1.1))


def write_log(folder, rows=8, unit=0.5, name="drive.csv"):
    """Each image has one brightness, which is also what the log says about steering."""
    lines = ["frame,angle"]
    for number in range(rows):
        cv2.imwrite(str(folder / f"{number}.png"), np.full((94, 168, 3), 20 * number, np.uint8))
        lines.append(f"{number}.png, {unit * (number - 4) / 4}")
    (folder / name).write_text("\n".join(lines) + "\n")
    return folder / name


def test_a_foreign_log_becomes_frames_with_its_own_view(tmp_path):
    log = open_log(write_log(tmp_path), CHOICE)
    view = view_of(log, view_for_size(336, 188))
    recording = frames_of(log, view, None, "recorded")
    assert (view.camera.width, view.camera.height) == (168, 94)
    assert recording.frames.images.shape == (8, 66, 200, 3)
    assert recording.frames.images[:, 30, 100, 0].tolist() == [20 * n for n in range(8)]
    assert recording.frames.steering_rad == pytest.approx([-0.25 * (n - 4) / 4 for n in range(8)])
    assert np.isnan(recording.frames.states).all()


@pytest.mark.parametrize(("width", "height", "first", "last"), [(640, 480, 61, 344), (64, 48, 6, 34)])
def test_a_calibrated_camera_of_any_size_is_cropped_at_the_fraction_of_our_own(
    tmp_path, width, height, first, last
):
    file = tmp_path / "camera.yaml"
    own = load_calibration(CameraCalibration, TWIN_CAMERA)
    intrinsics = {
        "width": width,
        "height": height,
        "fx": width,
        "fy": width,
        "cx": 0.5 * width,
        "cy": 0.5 * height,
    }
    save_calibration(own.model_copy(update=intrinsics), file)
    view = policy_view(file, [])
    image = np.zeros((height, width, 3), np.uint8)
    image[first:last] = 255  # rows 24 to 135 of 188
    assert view.image(image).min() == 255
    assert view.image(255 - image).max() == 0
    assert (view.camera.fx, view.distortion) == (width, own.distortion)


def attach(name, labels="expert", **files):
    """A log with attached calibration files, whose pictures are of the twin's camera."""
    contents = {
        f"{key}.yaml": yaml.safe_dump(content.model_dump(mode="json")).encode()
        for key, content in files.items()
    }
    image = np.zeros((188, 336, 3), np.uint8)
    log = SimpleNamespace(path=Path(name), attached=lambda: contents, first_image=lambda: image)
    return OpenLog(name, CHOICE, log, labels)


def test_an_expert_labels_the_logs_of_one_path_only():
    """Two rooms of the same kind: poses in the second are on another path than the first one's expert would follow."""
    twin = load_calibration(RoomCalibration, TWIN_CAMERA.with_name("room.yaml"))
    other = twin.model_copy(update={"path": DrivingPath.rounded_square(3.0, 0.8).to_dict()})
    same = twin.model_copy(update={"notes": "measured again"})
    agreed = room_of(
        None, [attach("a", room=twin), attach("b", room=same), attach("c", "recorded", room=other)]
    )
    assert agreed.path == twin.path
    logs = [attach("a", room=twin), attach("b", room=other)]
    with pytest.raises(ConfigError, match=r"room\.yaml of a and another path in that of b; train .* --room"):
        room_of(None, logs)
    assert room_of(TWIN_CAMERA.with_name("room.yaml"), logs).path == twin.path
    assert room_of(None, []) is None


def test_a_log_of_another_lens_of_the_same_size_is_said():
    own = load_calibration(CameraCalibration, TWIN_CAMERA)
    tele = own.model_copy(update={"fx": 1.2 * own.fx})
    straight = own.model_copy(update={"distortion": (0.2, 0.0, 0.0, 0.0, 0.0)})
    logs = [attach("a", camera=own), attach("b", camera=tele), attach("c", camera=straight), attach("d")]
    view = policy_view(None, logs)
    assert view.camera.fx == own.fx
    (b, c) = crop_notes(logs, view)
    assert b.startswith(f"b: its camera.yaml has another lens (fx {1.2 * own.fx:.4g}, ")
    assert c.startswith("c: its camera.yaml has another lens")
    assert "distortion [0.2, 0.0, 0.0, 0.0, 0.0]" in c


def test_our_own_camera_is_cropped_as_ever():
    own = load_calibration(CameraCalibration, TWIN_CAMERA)
    plain = PolicyView(own.pinhole, distortion=own.distortion)
    assert policy_view(TWIN_CAMERA, []).to_dict() == plain.to_dict()


def test_images_of_another_size_are_seen_through_the_policy_s_own_window(tmp_path):
    camera = Pinhole(84, 47, 44.0, 44.0, 42.0, 23.5)
    view = PolicyView(camera, 10, 20, 40, 30, (0.1, 0.0, 0.0, 0.0), crop_left_px=21, crop_width_px=42)
    log = write_log(tmp_path)
    image = np.random.default_rng(0).integers(0, 256, (94, 168, 3), dtype=np.uint8)
    cv2.imwrite(str(tmp_path / "0.png"), image[..., ::-1])
    opened = OpenLog("log", CHOICE, open_log(log, CHOICE), "recorded")
    seen = recorded_frames(opened, view, None).frames.images
    expected = cv2.resize(image[20:60, 42:126], (40, 30), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(seen[0], expected)
    (note,) = crop_notes([opened], view)
    assert note.endswith("same fraction as the policy's of 84 x 47, and not undistorted")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            lambda t: t.replace("angle", "wheel"),
            "csv:1: expected columns frame, angle, got frame, wheel; name yours with --images and --steering",
        ),
        (
            lambda t: t.replace("3.png", "no.png"),
            r"csv:5: frame: expected an image, found no file 'no\.png'",
        ),
        (lambda t: t.replace("2.png, -0.25", "2.png, left"), r"csv:4: angle: expected a number, got 'left'"),
        (
            lambda t: t.replace("2.png, -0.25", "2.png, 25"),
            "csv:4: expected a steering angle below 1 rad, got 25 times 0.5",
        ),
        (lambda t: "\n".join(t.split("\n")[:3]), "at least 4 usable frames"),
        (lambda t: "", "an empty file"),
        (
            lambda t: t.replace("2.png, -0.25", "2.png, -0,25"),
            "csv:4: expected 2 fields as in the header, got 3.*decimal point",
        ),
        (
            lambda t: t.replace("2.png, -0.25", '2.png,"-0,25"'),
            "csv:4: angle: expected a number, got '-0,25'; write a decimal point",
        ),
        (
            lambda t: t.replace("frame,angle", "frame,angle,angle"),
            "csv:1: the column angle is given twice",
        ),
        (
            lambda t: t.replace("2.png, -0.25", "2.png, left").replace("5.png, 0.125", "5.png, 9"),
            r"csv:4: angle.*\n.*csv:7: expected a steering angle",
        ),
    ],
)
def test_what_is_wrong_with_a_log_is_said(tmp_path, change, reason):
    log = write_log(tmp_path)
    log.write_text(change(log.read_text()))
    with pytest.raises((ConfigError, LogError), match=reason):
        frames_of(open_log(log, CHOICE), view_for_size(168, 94), None, "recorded")


def test_errors_against_numpy():
    rng = np.random.default_rng(0)
    true = rng.normal(0.0, 0.1, 200)
    predicted = 0.8 * true + 0.01 + rng.normal(0.0, 0.02, 200)
    true[::10] = np.nan
    e = compare(predicted, true)
    known = ~np.isnan(true)
    error = (predicted - true)[known]
    assert e.count == 180
    assert (e.mean_abs_rad, e.bias_rad) == (pytest.approx(np.abs(error).mean()), pytest.approx(error.mean()))
    assert e.rms_rad == pytest.approx(np.sqrt(error.var() + error.mean() ** 2))
    assert e.correlation == pytest.approx(np.corrcoef(predicted[known], true[known])[0, 1])
    with pytest.raises(ConfigError, match="recorded or labelled"):
        compare(predicted, np.full(200, np.nan))


@pytest.mark.parametrize(("gain", "is_told"), [(1.0, False), (-1.0, True), (-0.3, True), (0.0, False)])
def test_steering_to_the_other_side_is_told(gain, is_told):
    rng = np.random.default_rng(0)
    true = rng.normal(0.0, 0.1, 200)
    problem = compare(gain * true + rng.normal(0.0, 0.01, 200), true).problem
    assert problem.startswith("the steering seems reversed (r -") is is_told


def test_saliency_is_where_the_gradient_is():
    weight = torch.zeros(3, 66, 200)
    weight[:, 20, 150] = 1.0
    maps = saliency(
        lambda images, goals: (images * weight).sum((1, 2, 3)), np.zeros((3, 66, 200, 3), np.uint8)
    )
    assert maps.shape == (3, 66, 200)
    assert np.unravel_index(maps[1].argmax(), (66, 200)) == (20, 150)
    assert maps.max() == pytest.approx(1.0)
    assert maps[:, 40:].max() == 0.0


def test_the_video_of_saliency_plays_in_a_browser(tmp_path):
    images = np.full((3, 66, 200, 3), 90, np.uint8)
    recording = SimpleNamespace(frames=SimpleNamespace(images=images))
    files = write_saliency(lambda images, goals: images.mean((1, 2, 3)), recording, tmp_path, 0, video=True)
    assert files == [tmp_path / "saliency.mp4"]
    with av.open(str(files[0])) as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.frames) == ("h264", 3)
        assert (stream.height, stream.width) == (4 * 2 * 66, 4 * 200)


def test_a_policy_of_several_images_is_compared_in_the_order_of_the_recording():
    class Slower:
        stateless = False

        def initial_memory(self, batch):
            return torch.zeros(batch, 1)

        def __call__(self, images, goals, memory):
            return images.mean((1, 2, 3)) - memory[:, 0], images.mean((1, 2, 3))[:, None]

    greys = np.array([51, 102, 255, 204], np.uint8)
    images = np.broadcast_to(greys[:, None, None, None], (4, 66, 200, 3))
    assert predict(Slower(), images).tolist() == pytest.approx([0.2, 0.2, 0.6, -0.2], abs=1e-6)
    # Where another drive begins, there is no memory.
    assert predict(Slower(), images, (), [0, 2]).tolist() == pytest.approx([0.2, 0.2, 1.0, -0.2], abs=1e-6)
    assert saliency(Slower(), images).shape == (4, 66, 200)


def test_answers_that_are_no_numbers_are_not_left_out_of_the_errors():
    greys = np.array([10, 200, 10, 250], np.uint8)
    images = np.broadcast_to(greys[:, None, None, None], (4, 66, 200, 3))
    with pytest.raises(
        ConfigError, match=r"finite steering from the policy, got nan for 2 of 4 images, .* number 1;"
    ):
        predict(lambda images, goals: (0.5 - images.mean((1, 2, 3))).sqrt(), images)


@pytest.mark.parametrize(
    ("steer", "got"),
    [
        (lambda images: images.detach().mean((1, 2, 3)), "none: something cuts it off"),
        (lambda images: (0.0 * images.mean((1, 2, 3))).sqrt(), "one that is NaN or infinite"),
    ],
)
def test_a_map_without_a_gradient_is_refused(steer, got):
    with pytest.raises(
        ConfigError, match=f"a gradient of the steering in the images, got {got}.* --saliency 0"
    ):
        saliency(lambda images, goals: steer(images), np.zeros((2, 66, 200, 3), np.uint8))


IMAGES = np.random.default_rng(0).integers(0, 256, (100, 66, 200, 3), dtype=np.uint8)


def shard(rows):
    count = len(rows)
    numbers = np.zeros((count, 3)), np.zeros(count, np.float32), np.zeros((count, 0), np.float32)
    return Frames(IMAGES[rows], *numbers, np.zeros(count, bool))


@pytest.mark.parametrize(("common", "refused"), [(40, True), (10, True), (4, False), (0, False)])
def test_images_that_another_log_has_are_not_held_out(common, refused):
    """The second log has the last images of the first, in another order."""
    logs = {"one": shard(np.arange(50)), "two": shard(np.arange(50 - common, 100 - common)[::-1])}
    said = pytest.raises(
        LogError, match=f"every drive once.* got one and two, which have {common} images in common"
    )
    with said if refused else contextlib.nullcontext():
        training._refuse_shared_images(logs)


@pytest.mark.parametrize(
    ("rows", "again"),
    [
        ([*range(50), *range(50)], 50),
        ([*range(100), *range(80, 60, -1)], 20),
        ([*range(100), *range(5)], 0),
        ([*range(20), *[20] * 100, *range(21, 60), *[20] * 5], 0),  # a standing car, at one place twice
        ([*[3, 4] * 50, *range(5, 60)], 0),
        (np.arange(100) // 2, 0),  # a slow camera
    ],
)
def test_a_drive_that_is_in_one_log_twice_is_refused(rows, again):
    said = pytest.raises(
        LogError, match=f"every drive once.* got one, in which {again} of {len(rows)} images"
    )
    with said if again else contextlib.nullcontext():
        training._refuse_shared_images({"one": shard(np.array(rows))})


def test_training_learns_is_kept_and_begins_anew_for_other_recordings(tmp_path, monkeypatch):
    log = write_log(tmp_path)
    view = view_for_size(168, 94)
    cuts = []

    def cut(*given):
        cuts.append(1)
        return recorded_frames(*given)

    monkeypatch.setattr(training, "recorded_frames", cut)

    def train(steps=8):
        logs = [OpenLog("log", CHOICE, open_log(log, CHOICE), "recorded")]
        config = ImitationConfig(first_steps=steps, batch_size=16, dagger_rounds=0)
        return training.train_from_recordings(logs, view, EXPERT, config, tmp_path / "out")

    first = train()
    assert first.frames == {"log": 8}
    assert load_policy(first.path).sha256 == first.sha256
    assert train().sha256 == first.sha256
    assert len(cuts) == 1
    mine = tmp_path / "out" / "work" / "mine" / "thesis.tex"
    mine.parent.mkdir()
    mine.write_text("of the user, who keeps it here")
    write_log(tmp_path, rows=9)
    assert train().frames == {"log": 9}
    assert len(cuts) == 2
    image = sorted(tmp_path.rglob("*.png"))[0]
    assert image in open_log(log, CHOICE).files
    os.utime(image, (0, 0))
    train()
    assert len(cuts) == 3, "another image is another log, although its table is the same"
    assert mine.exists()
    assert len(list((tmp_path / "out" / "work").iterdir())) == 2
