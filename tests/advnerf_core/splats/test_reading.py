"""Every format reads what its own tool wrote, or bytes written by hand; damaged files give one line."""

import gzip
import random
import struct

import numpy as np
import pytest

from advnerf_core.data.similarity import Similarity
from advnerf_core.errors import AdvnerfError
from advnerf_core.geometry import make_transform
from advnerf_core.splats.gaussians import COLOUR_OFFSET, CONSTANT_BASIS, SplatError
from advnerf_core.splats.reading import read_splats
from tests.support.damaged_bytes import mutate
from tests.support.splats import (
    gaussians,
    glb_bytes,
    random_splats,
    sample_files,
    splat_bytes,
    write_ply,
    write_spz,
)

KHR = "KHR_gaussian_splatting"


def same(found, expected, tolerance=1e-6):
    """Whether two splats are equal; a quaternion and its negative are one rotation."""
    signs = np.sign((found.rotations * expected.rotations).sum(axis=1, keepdims=True))
    for one, other in (
        (found.means_m, expected.means_m),
        (found.scales_m, expected.scales_m),
        (signs * found.rotations, expected.rotations),
        (found.opacities, expected.opacities),
        (found.harmonics, expected.harmonics),
    ):
        np.testing.assert_allclose(one, other, atol=tolerance, rtol=tolerance)


@pytest.mark.parametrize("bands", [1, 2, 3, 4])
def test_a_ply_file_of_the_library_comes_back(tmp_path, bands):
    splats = random_splats(50, bands=bands).chosen(np.arange(50) % 7 > 0)
    same(read_splats(write_ply(tmp_path / "a.ply", splats)), splats, 2e-6)


def test_a_ply_file_written_by_hand_with_columns_in_another_order(tmp_path):
    names = [
        "rot_0",
        "rot_1",
        "rot_2",
        "rot_3",
        "x",
        "y",
        "z",
        "nx",
        "ny",
        "nz",
        "opacity",
        "scale_0",
        "scale_1",
        "scale_2",
        "f_dc_0",
        "f_dc_1",
        "f_dc_2",
    ]
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 1\n"
        + "".join(f"property float {n}\n" for n in names)
        + "end_header\n"
    )
    values = [
        2.0,
        0.0,
        0.0,
        2.0,
        1.0,
        2.0,
        3.0,
        0,
        0,
        0,
        0.0,
        np.log(0.1),
        np.log(0.2),
        np.log(0.3),
        1.0,
        0.0,
        -1.0,
    ]
    (tmp_path / "a.ply").write_bytes(header.encode() + struct.pack("<17f", *values))
    found = read_splats(tmp_path / "a.ply")
    np.testing.assert_allclose(found.means_m, [[1.0, 2.0, 3.0]])
    np.testing.assert_allclose(found.scales_m, [[0.1, 0.2, 0.3]], rtol=1e-6)
    np.testing.assert_allclose(found.rotations, [[0.5**0.5, 0.0, 0.0, 0.5**0.5]], rtol=1e-6)
    assert found.opacities[0] == 0.5
    np.testing.assert_allclose(found.harmonics[0, 0], [1.0, 0.0, -1.0])


@pytest.mark.parametrize("bands", [1, 4])
def test_a_compressed_ply_file_comes_back_nearly(tmp_path, bands):
    splats = random_splats(600, bands=bands)
    found = read_splats(write_ply(tmp_path / "a.ply", splats, compressed=True))
    assert found.harmonics.shape == splats.harmonics.shape
    # The library sorts by place: compare each with its nearest.
    nearest = np.linalg.norm(found.means_m[:, None] - splats.means_m[None], axis=2).argmin(axis=1)
    assert len(set(nearest)) > 590
    assert np.abs(found.means_m - splats.means_m[nearest]).max() < 0.01
    assert np.median(np.abs(np.log(found.scales_m / splats.scales_m[nearest]))) < 0.01


@pytest.mark.parametrize("version", [3, 4])
def test_an_spz_file_comes_back_to_its_precision(tmp_path, version):
    splats = random_splats(300, bands=4)
    splats.opacities.clip(0.05, 0.95, out=splats.opacities)
    found = read_splats(write_spz(tmp_path / "a.spz", splats, version))
    np.testing.assert_allclose(found.means_m, splats.means_m, atol=2**-12)
    np.testing.assert_allclose(np.log(found.scales_m), np.log(splats.scales_m), atol=0.04)
    np.testing.assert_allclose(found.opacities, splats.opacities, atol=0.003)
    assert np.abs((found.rotations * splats.rotations).sum(axis=1)).min() > 0.9999
    np.testing.assert_allclose(found.harmonics, splats.harmonics, atol=0.07)


def test_a_splat_file_written_by_hand(tmp_path):
    record = (
        struct.pack("<3f3f", 1.0, 2.0, 3.0, 0.1, 0.2, 0.3)
        + bytes([255, 0, 51, 204])
        + bytes([255, 128, 128, 128])
    )
    (tmp_path / "a.splat").write_bytes(2 * record)
    found = read_splats(tmp_path / "a.splat")
    assert len(found) == 2
    np.testing.assert_allclose(found.means_m[1], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(found.scales_m[0], [0.1, 0.2, 0.3], rtol=1e-6)
    np.testing.assert_allclose(found.opacities, 0.8, rtol=1e-6)
    np.testing.assert_allclose(
        CONSTANT_BASIS * found.harmonics[0, 0] + COLOUR_OFFSET, [1.0, 0.0, 0.2], atol=1e-6
    )
    np.testing.assert_allclose(found.rotations[0], [1.0, 0.0, 0.0, 0.0], atol=1e-6)


def test_a_splat_file_of_any_gaussians(tmp_path):
    splats = random_splats(100, bands=1)
    (tmp_path / "a.splat").write_bytes(splat_bytes(splats))
    found = read_splats(tmp_path / "a.splat")
    np.testing.assert_array_equal(found.means_m, splats.means_m)
    assert np.abs((found.rotations * splats.rotations).sum(axis=1)).min() > 0.999


@pytest.mark.parametrize("bands", [1, 2, 4])
def test_a_glb_file_comes_back(tmp_path, bands):
    splats = random_splats(40, bands=bands)
    (tmp_path / "a.glb").write_bytes(glb_bytes(splats))
    same(read_splats(tmp_path / "a.glb"), splats)


def test_sizes_of_a_glb_draft_are_logarithms(tmp_path):
    splats = random_splats(40)
    (tmp_path / "a.glb").write_bytes(glb_bytes(splats, arrays={f"{KHR}:SCALE": np.log(splats.scales_m)}))
    same(read_splats(tmp_path / "a.glb"), splats)


def test_a_glb_file_with_normalised_integers(tmp_path):
    splats = gaussians([[0.0, 0.0, 1.0]], 0.1, 0.5, [[0.2, 0.3, 0.4]], [[0.5, 0.5, -0.5, 0.5]])
    x_to_w = np.array([[64, -64, 64, 64]], np.int8)
    arrays = {f"{KHR}:ROTATION": x_to_w, f"{KHR}:OPACITY": np.array([51], np.uint8)}
    (tmp_path / "a.glb").write_bytes(glb_bytes(splats, arrays=arrays))
    found = read_splats(tmp_path / "a.glb")
    np.testing.assert_allclose(found.rotations, [[0.5, 0.5, -0.5, 0.5]], atol=1e-6)
    np.testing.assert_allclose(found.opacities, 0.2, rtol=1e-6)


def test_the_transform_of_a_glb_node_moves_turns_and_scales(tmp_path):
    splats = random_splats(40)
    turn = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    matrix = make_transform(2.0 * turn, [1.0, 2.0, 3.0])
    (tmp_path / "a.glb").write_bytes(glb_bytes(splats, matrix=matrix))
    same(
        read_splats(tmp_path / "a.glb"),
        splats.moved(Similarity(2.0, make_transform(turn, [1.0, 2.0, 3.0]))),
        1e-5,
    )


def refuse(tmp_path, content, message, suffix="glb"):
    path = tmp_path / f"a.{suffix}"
    path.write_bytes(content)
    with pytest.raises(SplatError, match=message) as caught:
        read_splats(path)
    assert len(str(caught.value).splitlines()) == 1


def test_glb_files_that_are_no_plain_splat_are_refused(tmp_path):
    splats = random_splats(5)
    primitive = lambda tree: tree["meshes"][0]["primitives"][0]  # noqa: E731

    def compressed(tree):
        primitive(tree)["extensions"][KHR]["extensions"] = {
            "KHR_gaussian_splatting_compression_spz_2": {"bufferView": 0}
        }

    refuse(tmp_path, glb_bytes(splats, compressed), "without compression.*spz_2")
    refuse(
        tmp_path,
        glb_bytes(splats, lambda tree: primitive(tree).pop("extensions")),
        "got none; give the splat",
    )
    refuse(
        tmp_path,
        glb_bytes(splats, lambda tree: primitive(tree)["attributes"].pop(f"{KHR}:OPACITY")),
        "without KHR_gaussian_splatting:OPACITY",
    )
    refuse(
        tmp_path,
        glb_bytes(
            splats, lambda tree: primitive(tree)["extensions"][KHR].update(colorSpace="lin_rec709_display")
        ),
        "colour space",
    )
    refuse(
        tmp_path,
        glb_bytes(splats, arrays={f"{KHR}:SCALE": np.ones((5, 3), np.uint8)}),
        "sizes of the type float",
    )
    refuse(tmp_path, glb_bytes(splats, matrix=np.diag([1.0, 2.0, 1.0, 1.0])), "scale evenly")
    refuse(tmp_path, glb_bytes(splats, matrix=np.diag([-1.0, 1.0, 1.0, 1.0])), "scale evenly")
    refuse(
        tmp_path,
        glb_bytes(splats, lambda tree: primitive(tree)["attributes"].update({f"{KHR}:SCALE": 99})),
        "damaged file .*not there",
    )
    refuse(tmp_path, glb_bytes(splats, lambda tree: primitive(tree).pop("attributes")), "damaged file")
    refuse(tmp_path, b"glTF", "damaged file")


def test_a_cloud_of_points_is_no_splat(tmp_path):
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty float x\nproperty float y\nproperty float z\nend_header\n"
    refuse(tmp_path, header.encode() + bytes(12), "points with x, y, z; give the splat", "ply")


@pytest.mark.parametrize("form", ["ascii", "binary_little_endian"])
def test_a_mesh_is_told_from_a_damaged_splat(tmp_path, form):
    content = (
        f"ply\nformat {form} 1.0\nelement vertex 8\nproperty float x\nelement face 12\n"
        "property list uchar int vertex_indices\nend_header\n"
    )
    refuse(tmp_path, content.encode(), "a mesh of triangles; .*scene object build", "ply")
    refuse(tmp_path, b"solid", "expected a splat file .*scene object build", "stl")


@pytest.mark.parametrize("kind", ["ply", "splat", "spz"])
def test_a_splat_without_points_is_no_damaged_file(tmp_path, kind):
    write_ply(tmp_path / "one.ply", random_splats(1, bands=1))
    header = (tmp_path / "one.ply").read_bytes().partition(b"end_header\n")
    contents = {
        "ply": header[0].replace(b"element vertex 1", b"element vertex 0") + header[1],
        "splat": b"",
        "spz": gzip.compress(struct.pack("<4sIIBBBB", b"NGSP", 3, 0, 0, 12, 0, 0)),
    }
    refuse(tmp_path, contents[kind], "got none, as it has no points", kind)


def test_ply_files_that_the_library_would_read_wrongly_are_refused(tmp_path):
    good = write_ply(tmp_path / "good.ply", random_splats(20)).read_bytes()
    refuse(tmp_path, good.replace(b"property float opacity", b"property uchar opacity"), "not float", "ply")
    refuse(tmp_path, good[:-1], "fewer in the file", "ply")
    refuse(
        tmp_path,
        good.replace(b"element vertex 20", b"element vertex 99999999999"),
        "at most 20,000,000",
        "ply",
    )
    refuse(tmp_path, good.replace(b"ply\n", b"plx\n", 1), "no PLY header", "ply")
    refuse(tmp_path, good[:200], "no PLY header", "ply")
    small = write_ply(tmp_path / "b.ply", random_splats(600), compressed=True).read_bytes()
    refuse(tmp_path, small.replace(b"element chunk 3", b"element chunk 1"), "1 chunks for 600", "ply")


def test_a_file_that_unpacks_to_gigabytes_is_refused(tmp_path):
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 10, 0, 12, 0, 0)
    refuse(tmp_path, gzip.compress(header + bytes(1 << 24)), "more data than Gaussians", "spz")
    header = struct.pack("<4sIIBBBB", b"NGSP", 3, 4_000_000_000, 0, 12, 0, 0)
    refuse(tmp_path, gzip.compress(header + bytes(100)), "at most 20,000,000", "spz")


def test_other_files_are_refused(tmp_path):
    refuse(tmp_path, b"", "expected Gaussians.*got none", "splat")
    refuse(tmp_path, bytes(33), "not whole records", "splat")
    refuse(tmp_path, b"x", r"expected a splat file \.ply", "ksplat")
    with pytest.raises(SplatError, match="found none"):
        read_splats(tmp_path / "missing.ply")


@pytest.mark.parametrize("name", ["ply", "compressed.ply", "spz", "v4.spz", "splat", "glb"])
def test_damaged_files_give_one_line_or_gaussians(tmp_path, name):
    good, chance, path = sample_files(tmp_path)[name], random.Random(0), tmp_path / f"damaged.{name}"
    lines = []
    for _ in range(60):
        path.write_bytes(mutate(chance, good))
        try:
            read_splats(path)
        except AdvnerfError as error:
            lines.append(len(str(error).splitlines()))
    assert set(lines) <= {1}
