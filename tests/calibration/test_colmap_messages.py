import dataclasses

import numpy as np
import pytest

from advnerf_core.data.lens import Lens
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import Pinhole
from calibration import colmap_messages as messages
from calibration.colmap_model import _require_enough
from calibration.photo_model import (
    FoundCamera,
    LeftOut,
    Model,
    PhotoSource,
    ReconstructionError,
    Registered,
    SfmConfig,
)

PINHOLE = Pinhole(640, 480, 601.1 / 3.0, 599.9, 320.0, 240.1)
LENS = Lens((0.1 / 3.0, -0.02, 0.0, 1e-9, 0.0))


def test_a_job_arrives_as_it_was_sent(tmp_path):
    sources = (
        PhotoSource("phone", ("a.jpg", "b.jpg"), True),
        PhotoSource("car", ("c.png",), pinhole=PINHOLE, lens=LENS),
    )
    job = messages.pack_job(tmp_path, sources, tmp_path / "work", SfmConfig(max_features=77, seed=3))
    assert job.count(b"\n") == 1
    assert messages.unpack_job(job) == (
        tmp_path,
        sources,
        tmp_path / "work",
        SfmConfig(max_features=77, seed=3),
    )


def test_a_model_arrives_to_the_bit():
    rng = np.random.default_rng(0)
    images = tuple(Registered(f"{k}.jpg", "phone", rng.normal(size=(4, 4)), PINHOLE, LENS) for k in range(3))
    camera = FoundCamera("phone", 3, "RADIAL", "5 images", PINHOLE, LENS, None)
    model = Model(
        images, (LeftOut("d.jpg", "no matches"),), rng.normal(size=(50, 3)) * 1e7, 0.31, 2, (camera,)
    )
    got = messages.unpack_answer(messages.pack_model(model))
    assert isinstance(got, Model)
    assert got.points.tobytes() == model.points.tobytes()
    for a, b in zip(got.images, images, strict=True):
        assert a.T_world_from_camera.tobytes() == b.T_world_from_camera.tobytes()
        assert (a.name, a.camera_id, a.pinhole, a.lens) == (
            b.name,
            b.camera_id,
            PINHOLE,
            LENS,
        )
    assert (got.left_out, got.cameras, got.parts, got.reprojection_error_px) == (
        model.left_out,
        (camera,),
        2,
        0.31,
    )


def test_a_model_without_a_point_has_invented_poses():
    """As of a camera that was only turned: all images have poses, and a reprojection error of 0."""
    images = tuple(Registered(f"{k}.jpg", "phone", np.eye(4), PINHOLE, LENS) for k in range(28))
    model = Model(images, (), np.zeros((0, 3)), 0.0, 1)
    with pytest.raises(ReconstructionError, match="got none: their poses are invented; move the camera"):
        _require_enough(model, [each.name for each in images], SfmConfig())
    _require_enough(dataclasses.replace(model, points=np.ones((50, 3))), [], SfmConfig())


def test_progress_and_errors_arrive():
    assert messages.unpack_answer(messages.pack_progress(0.25, "3 of 12 pairs")) == (0.25, "3 of 12 pairs")
    with pytest.raises(ReconstructionError, match="too few"):
        messages.unpack_answer(messages.pack_error(ReconstructionError("too few")))
    with pytest.raises(AdvnerfError, match="No space left") as caught:
        messages.unpack_answer(messages.pack_error(OSError(28, "No space left on device")))
    assert not isinstance(caught.value, ReconstructionError)
