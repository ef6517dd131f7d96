"""From a splat file to a scene: scale, up and frame, and a search in it."""

import numpy as np
import pytest

from advnerf_core.data.image_files import write_image
from advnerf_core.data.similarity import Similarity
from advnerf_core.data.transforms_write import write_transforms
from advnerf_core.documents import read_json
from advnerf_core.files import write_json
from advnerf_core.geometry import Pinhole, invert_transform, look_at, make_transform
from advnerf_core.scene.baked import BakedScene
from advnerf_core.splats.gaussians import SplatError
from advnerf_core.splats.renderer import SplatRenderer
from advnerf_core.splats.scene_file import load_splat_scene
from nodes.audit.images import posed
from nodes.experiment.node.prepare import load_request, prepare
from nodes.experiment.show.learned_scene import load_field
from nodes.lab.importing.errors import ImportRecordingError
from nodes.lab.importing.metric_options import MetricOptions
from nodes.lab.importing.splat import from_splat
from nodes.lab.importing.splat_options import SplatOptions
from nodes.runtime.errors import ConfigError
from tests.support.commands import advnerf
from tests.support.splats import glb_bytes, room, splat_bytes, write_ply
from tests.support.tiny_request import tiny_request

LENS = Pinhole(64, 40, 40.0, 40.0, 32.0, 20.0)
TURN = np.array([[0.0, 0.8, -0.6], [-1.0, 0.0, 0.0], [0.0, 0.6, 0.8]])


def test_a_known_length_and_the_axis_up_place_a_splat(tmp_path):
    truth = room(500)
    file_from_world = Similarity(4.0, make_transform(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 3.0]))
    file = write_ply(tmp_path / "a.ply", truth.moved(file_from_world))
    options = SplatOptions(metres_per_unit=0.25, up="-z", origin=(0.0, 0.0, 3.0))
    found = from_splat(file, tmp_path / "scene.safetensors", options)
    placed = load_splat_scene(tmp_path / "scene.safetensors")[0].splats
    order = [np.lexsort(each.means_m.round(3).T) for each in (placed, truth)]
    np.testing.assert_allclose(placed.means_m[order[0]], truth.means_m[order[1]], atol=1e-5)
    np.testing.assert_allclose(np.sort(placed.scales_m, axis=0), np.sort(truth.scales_m, axis=0), rtol=1e-5)
    assert found.count == 500
    assert np.abs(np.array(found.box)).max() < 2.6


@pytest.mark.parametrize("up", ["x", "-x", "y", "-y", "z", "-z"])
def test_the_axis_given_as_up_becomes_z(tmp_path, up):
    splats = room(60)
    splats.means_m[:] = 0.1 * splats.means_m + 5.0 * np.eye(3)["xyz".index(up[-1])] * (
        -1.0 if up[0] == "-" else 1.0
    )
    (tmp_path / "a.splat").write_bytes(splat_bytes(splats))
    from_splat(tmp_path / "a.splat", tmp_path / "s", SplatOptions(metres_per_unit=1.0, up=up))
    assert load_splat_scene(tmp_path / "s")[0].splats.means_m[:, 2].min() > 4.0


def test_a_glb_file_is_in_metres_with_y_up(tmp_path):
    splats = room(60)
    splats.means_m[:, 1] += 10.0
    (tmp_path / "a.glb").write_bytes(glb_bytes(splats))
    from_splat(tmp_path / "a.glb", tmp_path / "s", SplatOptions())
    assert load_splat_scene(tmp_path / "s")[0].splats.means_m[:, 2].min() > 7.0


def data_set(folder, truth, **report):
    """Images of a splat, posed in the world, and the report of an import."""
    poses = np.stack(
        [look_at(np.array([x, 0.2, 0.1]), np.array([2.0, 0.3 * x, 0.0])) for x in np.linspace(-1.5, 0.5, 5)]
    )
    pictures = SplatRenderer(truth).render(poses, LENS)[0].numpy()
    for k, picture in enumerate(pictures):
        write_image(folder / "images" / f"{k}.png", np.rint(255 * picture).astype(np.uint8))
    write_transforms(folder / "transforms.json", [f"images/{k}.png" for k in range(5)], poses, LENS)
    if report:
        write_json(folder / "import.json", report)
    return folder


# From the frame that a splat is trained in to that of the scan: itself, COLMAP's, and nerfstudio's, which its export keeps.
TRAINED_IN = {
    "scan": Similarity(1.0, np.eye(4)),
    "colmap": Similarity(
        3.0, make_transform(np.array([[0, 1, 0], [1, 0, 0], [0, 0, -1.0]]), [0.3, 0.0, 0.6])
    ),
    "dataparser": Similarity(
        5.0, make_transform(np.array([[0, 0, 1], [1, 0, 0], [0, 1, 0.0]]), [0.5, -0.2, 0.1])
    ),
}


def inverse(similarity):
    back, scale = invert_transform(similarity.T_target_from_source), 1.0 / similarity.scale
    return Similarity(scale, make_transform(back[:3, :3], scale * back[:3, 3]))


@pytest.mark.parametrize("flipped", [False, True])
@pytest.mark.parametrize("frame", TRAINED_IN)
def test_the_images_it_was_trained_on_place_a_splat(tmp_path, frame, flipped):
    truth = room(3000)
    trained = truth.moved(inverse(Similarity(0.5, make_transform(TURN, [1.0, 2.0, 3.0]))))
    trained = trained.moved(inverse(TRAINED_IN[frame]))
    if flipped:
        trained = trained.moved(Similarity(1.0, np.diag([1.0, -1.0, -1.0, 1.0])))
    images = data_set(
        tmp_path / "set",
        truth,
        scale_from="length",
        metres_per_unit=0.5,
        T_world_from_scan=make_transform(TURN, [1.0, 2.0, 3.0]).tolist(),
        scan={f"scan_units_per_{name}_unit": TRAINED_IN[name].scale for name in ("colmap", "dataparser")}
        | {
            f"T_scan_from_{name}": TRAINED_IN[name].T_target_from_source.tolist()
            for name in ("colmap", "dataparser")
        },
    )
    found = from_splat(write_ply(tmp_path / "a.ply", trained), tmp_path / "s", SplatOptions(images=images))
    assert found.psnr_db > 30.0
    assert found.metres_per_unit == pytest.approx(0.5 * TRAINED_IN[frame].scale)
    placed = load_splat_scene(tmp_path / "s")[0].splats
    np.testing.assert_allclose(np.sort(placed.means_m, axis=0), np.sort(truth.means_m, axis=0), atol=1e-4)


def test_images_that_it_does_not_show_are_refused(tmp_path):
    images = data_set(tmp_path / "set", room(2000), scale_from="length")
    other = write_ply(
        tmp_path / "a.ply",
        room(2000, colour=lambda points, face: np.random.default_rng(0).uniform(0, 1, points.shape) ** 4),
    )
    with pytest.raises(
        ImportRecordingError, match=r"expected a splat that shows the images of .* got a PSNR of"
    ):
        from_splat(other, tmp_path / "s", SplatOptions(images=images))
    unscaled = data_set(tmp_path / "unscaled", room(2000), scale_from=None)
    with pytest.raises(ImportRecordingError, match=r"expected a data set in metres .* unknown scale"):
        from_splat(other, tmp_path / "s", SplatOptions(images=unscaled))
    # As another program writes it: nothing says that its unit is the metre.
    foreign = data_set(tmp_path / "foreign", room(2000))
    with pytest.raises(ImportRecordingError, match=r"expected a data set in metres .* without import\.json"):
        from_splat(other, tmp_path / "s", SplatOptions(images=foreign))
    assert not (tmp_path / "s").exists()


def test_a_splat_without_a_known_length_is_refused(tmp_path):
    file = write_ply(tmp_path / "a.ply", room(60))
    with pytest.raises(
        ImportRecordingError, match=r"expected a known length, as .*a\.ply has none: --images"
    ):
        from_splat(file, tmp_path / "s", SplatOptions())
    with pytest.raises(ImportRecordingError, match=r"expected --images alone, .* got also --up"):
        from_splat(file, tmp_path / "s", SplatOptions(images=tmp_path, up="z"))
    with pytest.raises(ImportRecordingError, match="expected --box-low below --box-high"):
        from_splat(file, tmp_path / "s", SplatOptions(metres_per_unit=1.0, box_low=(9.0, 9.0, 9.0)))


def test_what_no_scene_has_is_refused(tmp_path):
    file, output = write_ply(tmp_path / "a.ply", room(60)), tmp_path / "s"
    for wrong, message in (
        ({"metres_per_unit": 1e4}, r"expected a scene of 0\.01 to 10000 m, got .* correct --metres-per-unit"),
        ({"metres_per_unit": 1e-4}, r"expected a scene of 0\.01 to 10000 m"),
        (
            {"box_low": (50.0, 50.0, 50.0), "box_high": (60.0, 60.0, 60.0)},
            r"a box with Gaussians in it, .* nearly all",
        ),
        ({"behind": (255.0, 255.0, 255.0)}, r"expected --behind as three numbers in 0\.\.1"),
    ):
        with pytest.raises(ImportRecordingError, match=message):
            from_splat(file, output, SplatOptions(**{"metres_per_unit": 1.0, **wrong}))
    assert not output.exists()
    from_splat(file, output, SplatOptions(metres_per_unit=1.0, behind=(1.0, 0.5, 0.0)))


def test_the_command_counts_what_it_leaves_out(tmp_path, monkeypatch, capsys):
    def told(*words):
        assert advnerf(monkeypatch, *map(str, words)) == 0
        return " ".join(capsys.readouterr().out.split())

    splats = room(400)
    splats.means_m[:3] = np.nan
    splats.scales_m[3] = 500.0
    file, scene = write_ply(tmp_path / "a.ply", splats), tmp_path / "scene.safetensors"
    text = told("scene", "from-splat", file, "-o", scene, "--metres-per-unit", 1, "--up", "z")
    assert "left out: 3 Gaussians: NaN, infinite or impossible numbers" in text
    assert "left out: 1 Gaussians: sizes beyond 10 times the scene's" in text
    assert "396 Gaussians" in text
    images = data_set(tmp_path / "set", room(400))
    told("scene", "render", scene, images, "-o", tmp_path / "views")
    assert len(list((tmp_path / "views").glob("*.png"))) >= 5
    assert "dB" in told("scene", "eval", scene, images)


def test_an_audit_of_a_splat_alone_names_the_command(tmp_path):
    file = write_ply(tmp_path / "a.ply", room(60))
    with pytest.raises(
        ConfigError, match=r"a splat alone cannot be compared .*'advnerf scene from-splat' makes a scene"
    ):
        posed(file, tmp_path / "audit", MetricOptions())
    with pytest.raises(SplatError, match="expected a splat file"):
        from_splat(tmp_path, tmp_path / "s", SplatOptions(metres_per_unit=1.0))


def test_a_splat_is_a_place_whose_searches_use_its_voxels(tmp_path):
    file = tiny_request(tmp_path / "request")
    splats = room(30_000, size_m=(7.0, 7.0, 2.4))
    splats.means_m[:, 2] += 1.2
    scene = tmp_path / "request" / "scene.safetensors"
    scene.unlink()
    from_splat(write_ply(tmp_path / "a.ply", splats), scene, SplatOptions(metres_per_unit=1.0, up="z"))
    experiment = load_request(file, (), tmp_path / "run")
    prepared = prepare(experiment)
    baked = read_json(tmp_path / "run" / "bake" / "baked.json")
    assert baked["psnr_to_scene_db"] > 25.0
    assert isinstance(load_field(experiment), SplatRenderer)
    assert isinstance(prepared.space.surrogate.background, BakedScene)
