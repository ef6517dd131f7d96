"""Photographs of two focal lengths by one camera: told from those of one by a lens for each image."""

import numpy as np
import pytest

from advnerf_core.data.lens import Lens
from advnerf_core.geometry import Pinhole
from benchmarks.painted_corner import poses_of, write_photographs
from calibration.photo_model import PhotoSource, ReconstructionError, SfmConfig
from calibration.structure_from_motion import reconstruct
from calibration.zoomed import OwnFocalLength, own_focal_lengths, require_one_focal_length
from tests.support.colmap_models import HEIGHT, WIDTH, synthetic

pytest.importorskip("pycolmap")

FOCAL_PX = 50.0
CENTRE = np.array([WIDTH / 2, HEIGHT / 2])


def zoomed_model(zoom_of):
    """A model that takes all images for those of one lens, though each was enlarged about its centre by its own zoom."""
    model = synthetic(frames=8, name="SIMPLE_PINHOLE")
    for zoom, (_, image) in zip(zoom_of, sorted(model.images.items()), strict=True):
        for point in image.points2D:
            point.xy = CENTRE + zoom * (point.xy - CENTRE)
    return model


def test_each_image_has_the_focal_length_of_its_own_zoom():
    zoom_of = [1.0, 1.0, 1.2, 1.0, 1.0, 1.2, 1.0, 1.0]
    model = zoomed_model(zoom_of)
    (camera,) = model.cameras
    found = own_focal_lengths(model, held=())[camera]
    assert [each.focal_px for each in found] == pytest.approx(FOCAL_PX * np.array(zoom_of), rel=0.01)
    assert model.cameras[camera].focal_length_x == FOCAL_PX, "the model stays"
    names = [each.image for each in found]
    with pytest.raises(
        ReconstructionError, match=rf"camera phone, got 2 of about 60 px \({names[2]}, {names[5]}\)"
    ):
        require_one_focal_length({"phone": found})
    assert own_focal_lengths(model, held={camera}) == {}


def test_images_of_one_lens_have_one_focal_length():
    model = zoomed_model([1.0] * 8)
    require_one_focal_length({"phone": own_focal_lengths(model, held=())[next(iter(model.cameras))]})


@pytest.mark.parametrize(
    "of_one",
    [
        [(400.0, 0.5)],
        [(400.0, 0.5), (410.0, 0.5), (405.0, 0.5)],  # it focused
        [(400.0, 2.0), (425.0, 2.0), (402.0, 2.0)],  # different, but not for sure
        [(400.0, 0.5), (405.0, 0.5), (600.0, 12.0)],  # it hardly says anything about its lens
    ],
)
def test_what_is_not_sure_is_no_zoom(of_one):
    images = [OwnFocalLength(f"{k}.jpg", *each) for k, each in enumerate(of_one)]
    require_one_focal_length({"phone": images})


@pytest.mark.slow
def test_photographs_of_two_zooms_are_refused_with_the_names_of_the_fewer(tmp_path):
    """One lens for all fits them within a pixel, and moves the cameras."""
    pinholes = [Pinhole(480, 360, f, f, 240.0, 180.0) for f in [420.0] * 8 + [500.0] * 3]
    truth = write_photographs(
        tmp_path, poses_of(11, 2.6, 1.4, 0.2, 1.37), [(each, Lens()) for each in pinholes]
    )
    with pytest.raises(
        ReconstructionError, match=r"got 3 of about \d+ px \(08\.png, 09\.png, 10\.png\) and 8 of"
    ):
        reconstruct(
            tmp_path, [PhotoSource("photos", tuple(truth))], tmp_path / "work", SfmConfig(max_features=1200)
        )
