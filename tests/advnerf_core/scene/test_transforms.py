import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from advnerf_core.data.errors import DatasetError
from advnerf_core.data.lens import Lens
from advnerf_core.data.transforms import load_transforms
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.geometry import OPENGL_FROM_OPENCV, Pinhole, look_at

FOX = Path("../shared/data/fox")
WIDTH, HEIGHT = 32, 24


def paint(path, width=WIDTH, height=HEIGHT, channels=3, value=90):
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), np.full((height, width, channels), value, np.uint8))


def pose(k=0):
    return (look_at([3.0, k, 1.0], [0.0, 0.0, 0.5]) @ OPENGL_FROM_OPENCV).tolist()


def write(folder, frames=None, name="transforms.json", **content):
    """A file whose frames are images 0.png, 1.png, ... unless given."""
    if frames is None:
        frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(2)]
    for frame in frames:
        if isinstance(frame, dict) and str(frame.get("file_path", "")).endswith("png"):
            paint(folder / frame["file_path"])
    (folder / name).write_text(json.dumps({"fl_x": 30.0, "frames": frames, **content}))
    return folder / name


def test_blender_folder_with_its_splits(tmp_path):
    for value, (split, count) in enumerate((("train", 3), ("val", 1), ("test", 2))):
        frames = [{"file_path": f"./{split}/r_{k}", "transform_matrix": pose(k)} for k in range(count)]
        for k in range(count):
            paint(tmp_path / split / f"r_{k}.png", channels=4, value=value)
        (tmp_path / f"transforms_{split}.json").write_text(
            json.dumps({"camera_angle_x": 0.69, "frames": frames})
        )
    listed = load_transforms(tmp_path)
    assert listed.splits == ("train", "val", "test")
    training, held_out = listed.training_and_held_out()
    assert (len(training.frames), len(held_out.frames)) == (3, 3)
    assert listed.frames[0].pinhole.fx == pytest.approx(0.5 * WIDTH / np.tan(0.345))
    assert len(load_transforms(tmp_path / "transforms_test.json").frames) == 2
    assert listed.load().alpha.shape == (6, HEIGHT, WIDTH)


def test_images_of_one_name_in_several_folders_have_names_of_their_own(tmp_path, monkeypatch):
    paths = ["left/0.png", "right/0.png", "../beside/0.png", str(tmp_path / "far" / "0.png")]
    frames = [{"file_path": path, "transform_matrix": pose(k)} for k, path in enumerate(paths)]
    (tmp_path / "set").mkdir()
    file = write(tmp_path / "set", frames)
    monkeypatch.chdir(tmp_path / "set")
    for given in (file, Path("transforms.json")):
        listed = load_transforms(given)
        names = [listed.name_of(frame) for frame in listed.frames]
        assert names == ["left/0.png", "right/0.png", "../beside/0.png", "../far/0.png"]


def test_a_photograph_and_its_copy_are_not_divided_into_learned_and_held_out(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(9)]
    # Pictures in the dark are all alike: only at one pose are they one photograph.
    listed = load_transforms(write(tmp_path, frames))
    assert len(listed.training_and_held_out()[1].frames) == 2
    moved = np.array(pose(3))
    moved[0, 3] += 0.002  # poses that were estimated for both, 8 m between the outer ones
    copy = {"file_path": "copies/3 (1).png", "transform_matrix": moved.tolist()}
    doubled = load_transforms(write(tmp_path, [*frames, copy]))
    two = r"3\.png again as copies/3 \(1\)\.png|copies/3 \(1\)\.png again as 3\.png"
    told = rf"each photograph once in .*got ({two}); take one of the two out"
    for divide in (doubled.training_and_held_out, lambda: doubled.split(2)):
        with pytest.raises(DatasetError, match=told):
            divide()
    paint(tmp_path / "copies" / "3 (1).png", value=91)
    assert len(doubled.training_and_held_out()[1].frames) == 2, "another photograph from the same place"


def test_a_copy_in_another_split_is_refused(tmp_path):
    for split in ("train", "test"):
        frames = [{"file_path": f"{split}/{k}.png", "transform_matrix": pose(k)} for k in range(2)]
        write(tmp_path, frames, f"transforms_{split}.json")
    with pytest.raises(DatasetError, match=r"got train/0\.png again as test/0\.png"):
        load_transforms(tmp_path).training_and_held_out()


def test_nerfstudio_lists_of_splits(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(4)]
    listed = load_transforms(
        write(tmp_path, frames, train_filenames=["0.png", "./2.png"], test_filenames=["3.png"])
    )
    assert [f.split for f in listed.frames] == ["train", None, "train", "test"]
    training, held_out = listed.training_and_held_out()
    assert [f.path.name for f in (*training.frames, *held_out.frames)] == ["0.png", "2.png", "3.png"]


def test_images_in_no_split_are_told(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(4)]
    listed = load_transforms(write(tmp_path, frames, train_filenames=["0.png"], val_filenames=["3.png"]))
    assert listed.remarks == [
        f"not used: 2 of 4 images, which are in no split of {tmp_path / 'transforms.json'}: 1.png, ..."
    ]
    assert load_transforms(write(tmp_path, frames, val_filenames=["3.png"])).remarks == [], "all are used"


def test_cameras_at_one_place_show_no_depth(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": np.eye(4).tolist()} for k in range(3)]
    with pytest.raises(DatasetError, match=r"cameras at different places .*got all 3 at 0, 0, 0"):
        load_transforms(write(tmp_path, frames)).require_places()
    load_transforms(write(tmp_path, frames[:1])).require_places()


def test_without_splits_every_nth_by_name_is_held_out(tmp_path):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in (3, 1, 2, 0)]
    training, held_out = load_transforms(write(tmp_path, frames)).training_and_held_out(every=2)
    assert [f.path.name for f in held_out.frames] == ["0.png", "2.png"]
    assert [f.path.name for f in training.frames] == ["1.png", "3.png"]


def test_one_image_can_be_loaded_but_not_held_out(tmp_path):
    listed = load_transforms(write(tmp_path, [{"file_path": "0.png", "transform_matrix": pose()}]))
    assert listed.load().rgb.shape == (1, HEIGHT, WIDTH, 3)
    with pytest.raises(DatasetError, match=r"expected at least 2 images in .*transforms\.json.* got 1"):
        listed.training_and_held_out()


def test_instant_ngp_scale_and_offset_place_the_box(tmp_path):
    listed = load_transforms(write(tmp_path, aabb_scale=2, scale=0.5, offset=[0.5, 0.25, 1.0]))
    low, high = listed.box()
    # u = 0.5 x + offset; the box is [-0.5, 1.5] in u.
    np.testing.assert_allclose(low, [-2.0, -1.5, -3.0])
    np.testing.assert_allclose(high, [2.0, 2.5, 1.0])


def test_fields_of_view_in_degrees_and_of_both_axes(tmp_path):
    frames = [{"file_path": "0.png", "transform_matrix": pose()}]
    write(tmp_path, frames, x_fov=90.0, camera_angle_y=np.pi / 2)
    content = json.loads((tmp_path / "transforms.json").read_text())
    del content["fl_x"]
    (tmp_path / "transforms.json").write_text(json.dumps(content))
    pinhole = load_transforms(tmp_path).frames[0].pinhole
    assert (pinhole.fx, pinhole.fy) == (pytest.approx(WIDTH / 2), pytest.approx(HEIGHT / 2))


def test_a_focal_length_of_a_frame_goes_before_one_of_the_file_in_another_form(tmp_path):
    """Two of three frames have another lens; the file's fl_x and fl_y are those of the third."""
    own = [{}, {"camera_angle_x": np.pi / 2}, {"fl_x": 50.0, "fl_y": 52.0}]
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k), **each} for k, each in enumerate(own)]
    file, wide = write(tmp_path, frames, fl_y=31.0), WIDTH / 2
    fl_x = json.loads(file.read_text())["fl_x"]
    found = [(each.pinhole.fx, each.pinhole.fy) for each in load_transforms(file).frames]
    assert found == [(fl_x, 31.0), (pytest.approx(wide), pytest.approx(wide)), (50.0, 52.0)]


@pytest.mark.parametrize(
    ("own", "common"),
    [("fl_x", "fl_y"), ("fl_y", "fl_x"), ("camera_angle_x", "camera_angle_y"), ("x_fov", "y_fov")],
)
def test_a_focal_length_of_a_frame_is_not_joined_with_the_files_for_the_other_axis(tmp_path, own, common):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(2)]
    frames[1][own] = 50.0 if own.startswith("fl") else 1.5
    file = write(tmp_path, frames, **{common: 31.0 if own.startswith("fl") else 1.2})
    with pytest.raises(
        DatasetError, match=rf"frame 1 \(1\.png\): {own}: expected .* of one lens, got .* {common} too"
    ):
        load_transforms(file)


def test_pixels_of_the_file_are_not_taken_for_those_of_a_frame_of_another_size(tmp_path):
    size = {"w": WIDTH * 2, "h": HEIGHT * 2}
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(2)]
    frames[1] |= {**size, "fl_x": 60.0, "fl_y": 60.0}
    file = write(tmp_path, frames, w=WIDTH, h=HEIGHT, cx=WIDTH / 2, cy=HEIGHT / 2)
    with pytest.raises(
        DatasetError,
        match=rf"frame 1 .*: w: expected the size of the file, {WIDTH}, as cx, cy .* its own cx, cy",
    ):
        load_transforms(file)
    frames[1] |= {"cx": WIDTH + 1.0, "cy": HEIGHT - 1.0}
    write(tmp_path, frames, w=WIDTH, h=HEIGHT, cx=WIDTH / 2, cy=HEIGHT / 2)
    assert load_transforms(file).frames[1].pinhole.cx == WIDTH + 1.0


def test_two_forms_of_one_focal_length_agree(tmp_path):
    """As in files of colmap2nerf, which have the focal length in pixels and the angle; images of half the size have other pixels."""
    angle = 2.0 * np.arctan(WIDTH / 2 / 30.0)
    file = write(tmp_path, camera_angle_x=angle, x_fov=float(np.degrees(angle)))
    assert load_transforms(file).frames[0].pinhole.fx == 30.0
    file = write(tmp_path, fl_x=60.0, camera_angle_x=angle)
    with pytest.raises(
        DatasetError,
        match=rf"every frame: fl_x: expected the lens that camera_angle_x = 0\.97.* says, 30 pixels in an image of {WIDTH}, got 60\.0; correct w",
    ):
        load_transforms(file)


@pytest.mark.parametrize(("key", "side"), [("cx", WIDTH), ("cy", HEIGHT)])
def test_a_centre_of_images_of_another_size_is_refused_where_no_size_is_given(tmp_path, key, side):
    assert load_transforms(write(tmp_path, **{key: 0.45 * side})).frames[0].pinhole
    with pytest.raises(DatasetError, match=rf"{key}: expected a centre near the middle .* add w and h"):
        load_transforms(write(tmp_path, **{key: 0.5 * side / 0.75}))
    # A crop says its size, and may have any centre.
    assert load_transforms(write(tmp_path, w=WIDTH, h=HEIGHT, **{key: 0.7 * side})).frames[0].pinhole


def test_cameras_of_one_set_keep_their_own_intrinsics_and_names(tmp_path):
    for name in ("phone.png", "car.png"):
        paint(tmp_path / name)
    pinholes = [
        Pinhole(WIDTH, HEIGHT, 30.0, 31.0, 16.0, 12.0),
        Pinhole(WIDTH, HEIGHT, 20.0, 20.0, 15.0, 11.0),
    ]
    lenses = [Lens((0.1, -0.05, 0.001, 0.0, 0.0)), Lens((0.01, 0.0, 0.0, 0.0), fisheye=True)]
    poses = np.stack([look_at([3.0, k, 1.0], [0.0, 0.0, 0.5]) for k in range(2)])
    path = tmp_path / "transforms.json"
    write_transforms(
        path, ["phone.png", tmp_path / "car.png"], poses, pinholes, lens=lenses, camera_ids=["phone", "car"]
    )
    listed = load_transforms(path)
    assert [f.pinhole for f in listed.frames] == pinholes
    assert [f.lens for f in listed.frames] == lenses
    assert listed.camera_ids == ("phone", "car")
    assert listed.of_camera("car").load().camera_ids == ("car",)
    with pytest.raises(DatasetError, match=r"cameras phone, car of .*transforms\.json, got 'drone'"):
        listed.of_camera("drone")


def test_windows_separators_and_frames_without_a_suffix(tmp_path):
    paint(tmp_path / "images" / "0.jpg")
    write(tmp_path, [{"file_path": "images\\0", "transform_matrix": pose()}])
    assert load_transforms(tmp_path).frames[0].path == tmp_path / "images" / "0.jpg"


def test_rounded_rotations_become_rotations(tmp_path):
    rounded = np.round(pose(1), 3).tolist()
    listed = load_transforms(write(tmp_path, [{"file_path": "0.png", "transform_matrix": rounded}]))
    R = listed.frames[0].T_world_from_camera[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)


def scaled(factor):
    matrix = np.array(pose())
    matrix[:3, :3] = matrix[:3, :3] * factor
    return matrix.tolist()


def moved(value):
    matrix = np.array(pose())
    matrix[0, 3] = value
    return matrix.tolist()


FRAME = r"transforms\.json: frame 1 \(1\.png\): "


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transform_matrix": moved(float("nan"))}, FRAME + "transform_matrix: expected finite numbers"),
        ({"transform_matrix": scaled(1.7)}, FRAME + r"transform_matrix: .*a stretch by 1\.7, 1\.7, 1\.7"),
        ({"transform_matrix": scaled([1.0, 1.0, -1.0])}, FRAME + "transform_matrix: .*a mirror image"),
        (
            {"transform_matrix": np.array(moved(2.0)).T.tolist()},
            FRAME + "transform_matrix: .*is it transposed",
        ),
        (
            {"transform_matrix": [[1, 2], [3, 4]]},
            FRAME + r"transform_matrix: expected 4 x 4 numbers, got shape \[2, 2\]",
        ),
        ({"transform_matrix": "eye"}, FRAME + "transform_matrix: expected 4 x 4 numbers"),
        ({"fl_x": -3}, FRAME + "fl_x: expected a positive number, got -3"),
        ({"fl_x": None}, FRAME + "fl_x: expected fl_x, camera_angle_x or x_fov"),
        (
            {"fl_x": None, "camera_angle_x": 4.0},
            FRAME + "camera_angle_x: expected a field of view below a half turn",
        ),
        ({"w": WIDTH, "h": None}, FRAME + "w: expected both w and h, or neither, got w alone"),
        ({"cx": "middle"}, FRAME + "cx: expected a number, got 'middle'"),
        ({"mask_path": "no.png"}, FRAME + r"mask_path: expected a mask at .*no\.png"),
        ({"file_path": "./0.png"}, r"file_path: expected each image once, got that of frame 0 again"),
        ({"fl_x": None, "x_fov": 1.35}, FRAME + "x_fov: expected a field of view in degrees, got 1.35"),
        ({"file_path": 7}, r"transforms\.json: frame 1 \(7\): file_path: expected the name"),
    ],
)
def test_a_wrong_field_is_one_error_with_file_frame_and_field(tmp_path, change, message):
    frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(2)]
    frames[1].update(change)
    with pytest.raises(DatasetError, match=message):
        load_transforms(write(tmp_path, frames))


def test_a_missing_pose_and_a_frame_that_is_no_object(tmp_path):
    with pytest.raises(DatasetError, match=r"frame 0 \(0\.png\): transform_matrix: .*missing"):
        load_transforms(write(tmp_path, [{"file_path": "0.png"}]))
    with pytest.raises(DatasetError, match=r"frame 0: expected an object with file_path"):
        load_transforms(write(tmp_path, ["0.png"]))
    with pytest.raises(DatasetError, match=r"scale: expected a positive number"):
        load_transforms(write(tmp_path, scale=0))


@pytest.mark.data
def test_fox_as_it_is_distributed():
    listed = load_transforms(FOX)
    assert (len(listed.frames), len(listed.missing)) == (50, 17)
    assert all(not path.exists() for path in listed.missing)
    assert listed.aabb_scale == 4
    training, held_out = listed.training_and_held_out(8)
    assert (len(training.frames), len(held_out.frames)) == (43, 7)
    view = held_out.with_frames(held_out.frames[:1]).load((270, 480))
    assert view.rgb.shape == (1, 480, 270, 3)
    assert view.pinholes[0].fx == pytest.approx(1375.52 / 4, rel=0.1)


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("distortion_params", [0.1, 0, 0, 0, 0, 0]),
        ("rolling_shutter", [0, 0, 1, 0]),
        ("ftheta_p0", 0.3),
        ("s1", 0.01),
        ("b1", 2.0),
        ("skew", 0.5),
        ("latlong", True),
        ("from_mitsuba", True),
        ("lens_model", "brown"),
    ],
)
@pytest.mark.parametrize("in_frame", [False, True])
def test_a_lens_that_others_read_and_we_do_not_is_named(tmp_path, key, value, in_frame):
    def file(value):
        frames = [{"file_path": f"{k}.png", "transform_matrix": pose(k)} for k in range(2)]
        if in_frame:
            frames[1][key] = value
        return write(tmp_path, frames, **({} if in_frame else {key: value}))

    with pytest.raises(DatasetError, match=rf"{key}: expected a lens of .*undistort"):
        load_transforms(file(value))
    nothing = [0] * len(value) if isinstance(value, list) else type(value)()
    assert load_transforms(file(nothing)).frames[1].lens.is_ideal


def test_keys_of_others_that_change_no_camera_are_told(tmp_path):
    frames = [
        {"file_path": f"{k}.png", "transform_matrix": pose(k), "depth_file_path": "d.png"} for k in range(2)
    ]
    listed = load_transforms(write(tmp_path, frames, white_transparent=True, fisheye_crop_radius=0))
    assert listed.ignored == ("white_transparent", "depth_file_path")
    assert listed.with_frames(listed.frames[:1]).remarks == [
        f"no effect here: the keys white_transparent, depth_file_path of {tmp_path / 'transforms.json'}"
    ]


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ({"fl_x": "abc"}, r"every frame: fl_x: expected a number, got 'abc'"),
        ({"is_fisheye": "false"}, r"every frame: is_fisheye: expected true or false, got 'false'"),
        ({"is_equirectangular": True}, r"every frame: camera_model: .*got is_equirectangular = true"),
        ({"offset": [1, 2]}, r"offset: expected one number or three, got 2"),
        ({"offset": True}, r"offset: expected a number, got True"),
    ],
)
def test_a_wrong_value_of_the_whole_file_is_told_once(tmp_path, content, message):
    with pytest.raises(DatasetError, match=message) as error:
        load_transforms(write(tmp_path, **content))
    assert "\n" not in str(error.value)


def test_a_split_names_files_that_frames_have(tmp_path):
    with pytest.raises(
        DatasetError, match=r"test_filenames: expected names .* got 1 that no frame has.*images/1\.png"
    ):
        load_transforms(write(tmp_path, train_filenames=["0.png"], test_filenames=["images/1.png"]))


def test_a_file_of_another_kind_is_told_by_what_is_expected(tmp_path):
    (tmp_path / "splat.ply").write_bytes(b"ply\n\xbf\x00")
    with pytest.raises(DatasetError, match=r"expected a transforms\.json or its folder, got .*splat\.ply"):
        load_transforms(tmp_path / "splat.ply")
