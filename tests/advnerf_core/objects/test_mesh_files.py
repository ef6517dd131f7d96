"""What formats of meshes mean by up, length and colour, and what they name, against files that are written here by hand."""

import base64
import io
import json
import struct
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from advnerf_core.objects.mesh.glb import glb_bytes
from advnerf_core.objects.mesh.surface import sphere, unwrapped
from advnerf_core.objects.voxel.build import LOST, THIN, advice, build_from_mesh, draw_object
from advnerf_core.objects.voxel.mesh import MeshError, SurfaceMesh, part_from_colours, texture_colours
from advnerf_core.objects.voxel.mesh_files import load_mesh, read_mesh_files
from advnerf_core.objects.voxel.views import ring, viewing_lens

CASE = Path(__file__).parents[4] / "shared/data/cases/glb_up_and_colour"
TRIANGLE = np.array([[0, 0, 0], [1, 0, 0], [0, 2, 0]], "<f4")
UV = np.array([[0, 0], [1, 0], [0, 1]], "<f4")


def png(colour=(10, 200, 30, 255)):
    buffer = io.BytesIO()
    Image.fromarray(np.full((4, 4, 4), colour, np.uint8)).save(buffer, "PNG")
    return buffer.getvalue()


def gltf(path, material, image=None, **header):
    """One triangle of 1 m along x and 2 m along y (glTF 2.0, sections 3.6 and 3.9)."""
    body = TRIANGLE.tobytes() + UV.tobytes()
    buffer = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    content = {
        "asset": {"version": "2.0"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0}],
        "meshes": [
            {"primitives": [{"attributes": {"POSITION": 0, "TEXCOORD_0": 1}, "material": 0, "mode": 4}]}
        ],
        "materials": [material],
        "accessors": [
            {"bufferView": 0, "componentType": 5126, "count": 3, "type": "VEC3", "min": [0, 0, 0], "max": [1, 2, 0]},
            {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2"},
        ],
        "bufferViews": [
            {"buffer": 0, "byteOffset": 0, "byteLength": 36},
            {"buffer": 0, "byteOffset": 36, "byteLength": 24},
        ],
        "buffers": [{"uri": buffer, "byteLength": len(body)}],
        **header,
    }  # fmt: skip
    if image is not None:
        content |= {"images": [{"uri": image}], "textures": [{"source": 0}]}
    path.write_text(json.dumps(content))
    return path


def pbr(**values):
    return {"pbrMetallicRoughness": values}


TEXTURED = {"baseColorTexture": {"index": 0}}


def obj(folder, name="a.obj", material="map_Kd my texture.png"):
    (folder / name).write_text(
        "mtllib a.mtl\nv 0 0 0\nv 1 0 0\nv 0 0 2\nvt 0 0\nvt 1 0\nvt 0 1\nusemtl m\nf 1/1 2/2 3/3\n"
    )
    if material is not None:
        (folder / "a.mtl").write_text(f"newmtl m\nKd 0.5 0.25 0\n{material}\n")
    return folder / name


def test_gltf_stands_on_its_y_and_factors_are_linear_light(tmp_path):
    mesh = load_mesh(gltf(tmp_path / "a.gltf", pbr(baseColorFactor=[0.5, 0.25, 0.0, 1.0])))
    np.testing.assert_allclose(mesh.size_m, [0.0, 1.0, 2.0], atol=1e-6)
    np.testing.assert_allclose(mesh.parts[0].texture[0, 0], [0.735, 0.537, 0.0], atol=2e-3)
    np.testing.assert_allclose(load_mesh(tmp_path / "a.gltf", up="z").size_m, [1.0, 2.0, 0.0], atol=1e-6)


def test_a_factor_darkens_a_texture_in_linear_light(tmp_path):
    (tmp_path / "t.png").write_bytes(png((188, 188, 188, 255)))  # half of the light
    plain = load_mesh(gltf(tmp_path / "a.gltf", pbr(**TEXTURED), "t.png"))
    assert (np.rint(255 * plain.parts[0].texture) == 188).all()
    half = load_mesh(gltf(tmp_path / "b.gltf", pbr(**TEXTURED, baseColorFactor=[0.5, 0.5, 0.5, 1]), "t.png"))
    np.testing.assert_allclose(half.parts[0].texture, 0.537, atol=3e-3)  # a quarter of the light


@pytest.mark.parametrize("kind", ["<f4", "u1", "<u2"])
def test_vertex_colours_count_beside_a_material(tmp_path, kind):
    """glTF multiplies them with its factor (section 3.7.2.1), as exports of scanners and of Blender have them."""
    largest = 1.0 if kind == "<f4" else np.iinfo(kind).max
    colours = np.tile(np.array([[1.0, 0.5, 0.0, 1.0]]) * largest, (3, 1)).astype(kind)
    buffer = {"uri": "colours.bin", "byteLength": colours.nbytes}
    (tmp_path / "colours.bin").write_bytes(colours.tobytes())

    def coloured(name, material, image=None):
        content = json.loads(gltf(tmp_path / name, material, image).read_text())
        content["buffers"].append(buffer)
        content["bufferViews"].append({"buffer": 1, "byteOffset": 0, "byteLength": colours.nbytes})
        component = {"<f4": 5126, "u1": 5121, "<u2": 5123}[kind]
        content["accessors"].append(
            {"bufferView": 2, "componentType": component, "count": 3, "type": "VEC4", "normalized": kind != "<f4"}
        )  # fmt: skip
        content["meshes"][0]["primitives"][0]["attributes"]["COLOR_0"] = 2
        (tmp_path / name).write_text(json.dumps(content))
        return load_mesh(tmp_path / name)

    plain = coloured("a.gltf", pbr())
    np.testing.assert_allclose(plain.parts[0].texture[0, 0], [1.0, 0.735, 0.0], atol=3e-3)
    half = coloured("b.gltf", pbr(baseColorFactor=[0.5, 0.5, 1.0, 1.0]))
    np.testing.assert_allclose(half.parts[0].texture[0, 0], [0.735, 0.537, 0.0], atol=3e-3)
    (tmp_path / "t.png").write_bytes(png())
    (note,) = coloured("c.gltf", pbr(**TEXTURED), "t.png").notes
    assert "colours of vertices over a texture; they are left out" in note


@pytest.mark.parametrize("largest", [1, 255])
def test_vertex_colours_of_an_obj_count_beside_a_material_without_an_image(tmp_path, largest):
    rows = "".join(f"v {place} {largest} 0 0\n" for place in ("0 0 0", "1 0 0", "0 0 2"))
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{rows}usemtl m\nf 1 2 3\n")
    (tmp_path / "a.mtl").write_text("newmtl m\nKd 0.8 0.8 0.8\n")
    np.testing.assert_allclose(load_mesh(tmp_path / "a.obj", unit="m").parts[0].texture[0, 0], [1, 0, 0])


@pytest.mark.skipif(not CASE.exists(), reason="the shared cases are not here")
def test_a_strangers_glb_stands_and_has_its_colour():
    np.testing.assert_allclose(load_mesh(CASE / "yup.glb").size_m, [0.3, 0.3, 1.0], atol=0.01)
    colour = load_mesh(CASE / "factor.glb").parts[0].texture[0, 0]
    np.testing.assert_allclose(colour, [0.735, 0.537, 0.0], atol=3e-3)


@pytest.mark.parametrize(("suffix", "options"), [("glb", {}), ("ply", {"up": "y", "unit": "m"})])
def test_the_front_of_a_file_with_y_up_is_z_and_becomes_x(tmp_path, suffix, options):
    """glTF 2.0, section 3.4: +y up, +z forward, -x right; ROS REP 103: x forward, y left, z up."""
    marks = np.repeat(
        np.eye(3)[[2, 0, 1]], 3, axis=0
    )  # forward, left and up, as triangles in red, green and blue
    corners = marks + 0.05 * np.tile(np.roll(np.eye(3), 1, axis=0), (3, 1))
    file = tmp_path / f"marks.{suffix}"
    colours = np.repeat(255 * np.eye(3, dtype=np.uint8), 3, axis=0)
    trimesh.Trimesh(corners, np.arange(9).reshape(3, 3), vertex_colors=colours, process=False).export(file)
    (part,) = load_mesh(file, **options).parts
    middles = part.triangles.mean(axis=1)
    rgb = texture_colours(part.texture, part.uv.mean(axis=1))
    for axis in range(3):  # x, y and z of a robot
        assert np.argmax(rgb[np.argmax(middles[:, axis])]) == axis


def test_what_this_software_writes_it_reads_upright(tmp_path):
    tall = SurfaceMesh(
        tuple(
            part_from_colours(p.triangles * [1, 1, 3], np.ones((len(p.triangles), 3)))
            for p in sphere(0.3, (1, 0, 0)).parts
        )
    )
    (tmp_path / "found.glb").write_bytes(glb_bytes(unwrapped(tall)))
    read = load_mesh(tmp_path / "found.glb")
    np.testing.assert_allclose(read.size_m, tall.size_m, atol=1e-5)
    written = np.sort(np.concatenate([each.triangles.mean(axis=1) for each in tall.parts]), axis=0)
    found = np.sort(np.concatenate([each.triangles.mean(axis=1) for each in read.parts]), axis=0)
    np.testing.assert_allclose(found - found.mean(axis=0), written - written.mean(axis=0), atol=1e-5)


@pytest.mark.parametrize(("unit", "factor"), [("mm", 0.001), ("cm", 0.01), ("m", 1.0), ("in", 0.0254)])
def test_a_unit_that_a_format_does_not_say_is_asked_for(tmp_path, unit, factor):
    box = trimesh.creation.box((40.0, 60.0, 100.0))
    for suffix in ("stl", "obj", "ply"):
        path = tmp_path / f"box.{suffix}"
        box.export(path)
        with pytest.raises(
            MeshError, match=rf"unit of .*box\.{suffix}, .*mm \(longest side 0\.1 m\).*in \(.*2\.54 m"
        ):
            load_mesh(path)
        np.testing.assert_allclose(
            load_mesh(path, unit=unit).size_m, np.array([40, 60, 100]) * factor, rtol=1e-6
        )
        assert load_mesh(path, height_m=0.5).size_m[2] == pytest.approx(0.5)
    with pytest.raises(MeshError, match="expected a unit of mm, cm, m, in, got 'ft'"):
        load_mesh(path, unit="ft")


def test_a_gltf_in_millimetres_is_refused_with_the_line_to_add(tmp_path):
    trimesh.Scene(trimesh.creation.box((40.0, 1000.0, 100.0))).export(tmp_path / "box.glb")
    with pytest.raises(
        MeshError, match=r"in metres, as glTF defines, got .* 1000 m; .*mm \(longest side 1 m\)"
    ):
        load_mesh(tmp_path / "box.glb")
    np.testing.assert_allclose(load_mesh(tmp_path / "box.glb", unit="mm").size_m, [0.1, 0.04, 1.0])


@pytest.mark.parametrize(
    ("known", "message"),
    [
        ({"unit": "m"}, r"got 1000 m by the unit m"),
        ({"height_m": 75.0}, r"got 750 m by a height of 75 m"),
        ({"height_m": 0.0005}, r"got 0\.005 m by a height of 0\.0005 m"),
    ],
)
def test_a_unit_or_height_that_makes_no_object_is_refused(tmp_path, known, message):
    trimesh.creation.box((40.0, 1000.0, 100.0)).export(tmp_path / "box.stl")
    with pytest.raises(MeshError, match=r"a longest side of 0\.01 to 100 m, " + message):
        load_mesh(tmp_path / "box.stl", **known)


def test_an_objects_files_are_found_and_hashed(tmp_path):
    path = obj(tmp_path)
    (tmp_path / "my texture.png").write_bytes(png())
    assert list(read_mesh_files(path)[0].others) == ["a.mtl", "my texture.png"]
    texture = load_mesh(path, unit="m").parts[0].texture
    np.testing.assert_allclose(255 * texture[0, 0], [10, 200, 30], atol=0.5)
    digests = [load_mesh(path, unit="m").sha256]
    (tmp_path / "my texture.png").write_bytes(png((11, 200, 30, 255)))
    digests.append(load_mesh(path, unit="m").sha256)
    (tmp_path / "a.mtl").write_text((tmp_path / "a.mtl").read_text() + "# other\n")
    digests.append(load_mesh(path, unit="m").sha256)
    (tmp_path / "notes.txt").write_text("not named by it")
    assert load_mesh(path, unit="m").sha256 == digests[-1]
    assert len(set(digests)) == 3


def test_named_files_elsewhere_or_behind_a_link_are_refused(tmp_path):
    folder, other = tmp_path / "mesh", tmp_path / "my texture.png"
    folder.mkdir()
    other.write_bytes(png())
    path = obj(folder)
    (folder / "my texture.png").symlink_to(other)
    with pytest.raises(MeshError, match=r"refers to my texture\.png, expected .* without links"):
        load_mesh(path, unit="m")
    for name in ("../my%20texture.png", str(other)):
        with pytest.raises(MeshError, match=r"refer to files in its own folder, got .*my texture\.png"):
            load_mesh(gltf(folder / "a.gltf", pbr(**TEXTURED), name))


@pytest.mark.parametrize("places", ["of corners", "of vertices"])
def test_a_ply_has_the_texture_that_its_header_names(tmp_path, places):
    """As MeshLab and photogrammetry write it."""
    of_corners = places == "of corners"
    vertices, face = ["0 0 0", "1 0 0", "0 0 2"], "3 0 1 2"
    if not of_corners:
        vertices = [f"{place} {u} {v}" for place, (u, v) in zip(vertices, UV, strict=True)]
    own = "" if of_corners else "property float s\nproperty float t\n"
    faces = "property list uchar float texcoord\n" if of_corners else ""
    (tmp_path / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile my texture.png\nelement vertex 3\nproperty float x\nproperty float y\n"
        f"property float z\n{own}element face 2\nproperty list uchar int vertex_indices\n{faces}end_header\n"
        + "\n".join([*vertices, *[face + " 6 0 0 1 0 0 1" * of_corners] * 2, ""])
    )
    with pytest.raises(MeshError, match=r"refers to my texture\.png, .*No such file"):
        load_mesh(tmp_path / "a.ply", unit="m")
    (tmp_path / "my texture.png").write_bytes(png())
    mesh = load_mesh(tmp_path / "a.ply", unit="m")
    np.testing.assert_allclose(255 * mesh.parts[0].texture[0, 0], [10, 200, 30], atol=0.5)
    np.testing.assert_allclose(mesh.parts[0].uv[0], UV)
    assert list(read_mesh_files(tmp_path / "a.ply")[0].others) == ["my texture.png"]


def test_options_of_an_image_are_refused_and_its_key_may_be_in_any_case(tmp_path):
    (tmp_path / "t.png").write_bytes(png())
    with pytest.raises(MeshError, match=r"name of an image alone .*, got -s 2 2 1 t\.png; remove"):
        load_mesh(obj(tmp_path, material="map_Kd -s 2 2 1 t.png"), unit="m")
    texture = load_mesh(obj(tmp_path, material="MAP_KD t.png"), unit="m").parts[0].texture
    np.testing.assert_allclose(255 * texture[0, 0], [10, 200, 30], atol=0.5)


def test_a_mesh_is_made_of_what_was_hashed(tmp_path, monkeypatch):
    """A file that changes while the mesh is read: image and hash are of the same content."""
    path = obj(tmp_path)
    (tmp_path / "my texture.png").write_bytes(png())
    before = load_mesh(path, unit="m")
    reads = trimesh.load_scene

    def changed_meanwhile(*given, **options):
        (tmp_path / "my texture.png").write_bytes(png((0, 0, 0, 255)))
        (tmp_path / "a.mtl").unlink()
        return reads(*given, **options)

    monkeypatch.setattr(trimesh, "load_scene", changed_meanwhile)
    read = load_mesh(path, unit="m")
    assert read.sha256 == before.sha256
    np.testing.assert_array_equal(read.parts[0].texture, before.parts[0].texture)


def test_named_files_that_are_missing_or_broken_are_errors(tmp_path):
    path = obj(tmp_path, material=None)
    with pytest.raises(MeshError, match=r"refers to a\.mtl, .*No such file"):
        load_mesh(path, unit="m")
    obj(tmp_path)
    with pytest.raises(MeshError, match=r"refers to my texture\.png, .*No such file"):
        load_mesh(path, unit="m")
    for content in (b"", png()[:45]):
        (tmp_path / "my texture.png").write_bytes(content)
        with pytest.raises(MeshError, match=r"readable texture, got .*my texture\.png"):
            load_mesh(path, unit="m")
    with pytest.raises(MeshError, match=r"refers to not there\.png, .*No such file"):
        load_mesh(gltf(tmp_path / "a.gltf", pbr(**TEXTURED), "not%20there.png"))


def test_a_broken_image_inside_a_glb_is_an_error(tmp_path):
    (tmp_path / "a.glb").write_bytes(glb_bytes(unwrapped(sphere(0.3, (1, 0, 0)))))
    data = bytearray((tmp_path / "a.glb").read_bytes())
    at = data.index(b"\x89PNG")
    data[at + 8 : at + 40] = bytes(32)
    (tmp_path / "a.glb").write_bytes(data)
    with pytest.raises(MeshError, match=r"readable texture, got image 0 of .*a\.glb"):
        load_mesh(tmp_path / "a.glb")


@pytest.mark.parametrize("mode", ["OPAQUE", "MASK", "BLEND"])
def test_a_transparent_texture_is_told_where_it_counts(tmp_path, mode):
    (tmp_path / "t.png").write_bytes(png((10, 200, 30, 100)))
    mesh = load_mesh(gltf(tmp_path / "a.gltf", {**pbr(**TEXTURED), "alphaMode": mode}, "t.png"))
    np.testing.assert_allclose(255 * mesh.parts[0].texture[0, 0], [10, 200, 30], atol=0.5)
    assert [("transparent in 100%" in note) for note in mesh.notes] == [True] * (mode != "OPAQUE")


@pytest.mark.parametrize("key", ["extensionsRequired", "extensionsUsed"])
def test_an_extension_that_changes_the_picture_is_named(tmp_path, key):
    path = gltf(tmp_path / "a.gltf", pbr(), **{key: ["KHR_texture_transform"]})
    with pytest.raises(MeshError, match="KHR_texture_transform"):
        load_mesh(path)
    load_mesh(gltf(tmp_path / "b.gltf", pbr(), **{key: ["KHR_materials_unlit"]}))


def test_a_texture_by_other_coordinates_than_the_first_is_refused(tmp_path):
    (tmp_path / "t.png").write_bytes(png())
    path = gltf(tmp_path / "a.gltf", pbr(baseColorTexture={"index": 0, "texCoord": 1}), "t.png")
    with pytest.raises(MeshError, match=r"first texture coordinates .*, got texCoord 1; make these"):
        load_mesh(path)


def test_glb_headers_that_lie_are_one_error(tmp_path):
    for content in (b"glTF", b"glTF" + struct.pack("<IIII", 2, 20, 1 << 30, 0), b"[]", b""):
        (tmp_path / "a.glb").write_bytes(content)
        with pytest.raises(MeshError, match=r"cannot read .*a\.glb"):
            load_mesh(tmp_path / "a.glb")


def bottle():
    """35 mm thick below, 12 mm at its neck, 260 mm high."""
    outline = np.array([[0, 0], [0.035, 0], [0.035, 0.16], [0.012, 0.2], [0.012, 0.26], [0, 0.26]])
    surface = trimesh.creation.revolve(outline, sections=24)
    return SurfaceMesh(
        (part_from_colours(surface.vertices[surface.faces], np.full((len(surface.faces), 3), 0.5)),)
    )


def test_voxels_that_lose_the_object_are_refused_or_told():
    with pytest.raises(
        MeshError, match=r"8 along its longest side lose \d+% of it: one is 65 mm.*--resolution"
    ):
        build_from_mesh(bottle(), "bottle", 8, 0)
    coarse = build_from_mesh(bottle(), "bottle", 16, 0).about
    assert THIN < coarse["missing"] < LOST
    assert "thinner than a voxel; raise --resolution" in advice(coarse)[0]
    fine = build_from_mesh(bottle(), "bottle", 32, 0).about
    assert (fine["missing"] < THIN, advice(fine)) == (True, [])
    assert fine["held_out_object_psnr_db"] < fine["held_out_psnr_db"] - 5.0


@pytest.mark.parametrize(
    ("mode", "alpha", "noted"), [("BLEND", 0.3, True), ("OPAQUE", 0.3, False), ("BLEND", 1.0, False)]
)
def test_a_material_that_is_transparent_is_noted(tmp_path, mode, alpha, noted):
    material = {"alphaMode": mode, **pbr(baseColorFactor=[0.5, 0.5, 0.5, alpha])}
    notes = load_mesh(gltf(tmp_path / "a.gltf", material)).notes
    assert any("a material of a.gltf is opaque to 30% only" in note for note in notes) == noted


def test_a_sheet_that_no_voxels_hold_is_made_a_voxel_thick(tmp_path):
    """A sign of other software is often two triangles."""
    corners = np.array([[-1.0, 0, 0], [1, 0, 0], [1, 1, 0], [-1, 1, 0]])
    sheet = trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], vertex_colors=[[255, 0, 0]] * 4, process=False)
    sheet.export(tmp_path / "sign.glb")
    built = build_from_mesh(load_mesh(tmp_path / "sign.glb"), "sign", 32, 60)
    assert built.about["missing"] < THIN
    assert "its sheets are thinner than a voxel, and were made about 71.4 mm thick" in built.about["notes"][0]
    thick, wide, high = np.subtract(*built.solid_box[::-1])
    assert 0.5 < thick / built.grids.voxel < 4.0  # of whole voxels, and the sheet lies between two
    assert (wide, high) == (pytest.approx(2.0, abs=0.25), pytest.approx(1.0, abs=0.25))
    front = draw_object(built, ring(built.solid_box, 1), viewing_lens(64))[0]
    np.testing.assert_allclose(front[32, 32], [1.0, 0.0, 0.0, 1.0], atol=0.1)


def accessors(**change):
    """Those of `gltf`, the second, of texture coordinates, with a change."""
    place = {
        "bufferView": 0,
        "componentType": 5126,
        "count": 3,
        "type": "VEC3",
        "min": [0, 0, 0],
        "max": [1, 2, 0],
    }
    return [place, {"bufferView": 1, "componentType": 5126, "count": 3, "type": "VEC2", **change}]


@pytest.mark.parametrize(
    ("header", "got"),
    [
        ({"nodes": [{"mesh": 0, "skin": 0, "scale": [0.1, 0.1, 0.1]}]}, "a skin, whose bones place"),
        ({"nodes": [{"mesh": 0, "weights": [1.0]}]}, "weights of morph targets"),
        ({"accessors": accessors(sparse={"count": 1})}, "sparse accessors"),
        (
            {"accessors": accessors(componentType=5123, normalized=True)},
            "texture coordinates as whole numbers",
        ),
        ({"meshes": [{"primitives": [{"attributes": {"POSITION": 0}, "mode": 6}]}]}, "triangle fans"),
    ],
)
def test_geometry_of_gltf_that_the_reader_leaves_out_is_refused(tmp_path, header, got):
    """Each had been read as another shape, or with other colours, without a word."""
    with pytest.raises(MeshError, match=rf"expected plain triangles in .*, got {got}"):
        load_mesh(gltf(tmp_path / "a.gltf", pbr(), **header))
    weightless = {"nodes": [{"mesh": 0, "weights": [0.0]}], "accessors": accessors()}
    assert load_mesh(gltf(tmp_path / "b.gltf", pbr(), **weightless)).size_m.max() == pytest.approx(2.0)


@pytest.mark.parametrize("wrap", [33071, 33648])
def test_an_image_that_ends_at_its_edge_needs_coordinates_within(tmp_path, wrap):
    (tmp_path / "a.png").write_bytes(png())
    file = gltf(tmp_path / "a.gltf", pbr(**TEXTURED), "a.png")
    content = json.loads(file.read_text())
    content |= {"samplers": [{"wrapS": wrap}], "textures": [{"source": 0, "sampler": 0}]}
    file.write_text(json.dumps(content))
    assert load_mesh(file).parts[0].texture.shape == (4, 4, 3)
    body = TRIANGLE.tobytes() + (2.0 * UV - 0.5).astype("<f4").tobytes()
    content["buffers"][0]["uri"] = "data:application/octet-stream;base64," + base64.b64encode(body).decode()
    file.write_text(json.dumps(content))
    with pytest.raises(MeshError, match=r"texture coordinates within 0\.\.1 in .* clamped or mirrored"):
        load_mesh(file)
    content["samplers"] = [{"wrapS": 10497}]
    file.write_text(json.dumps(content))
    assert load_mesh(file).parts[0].uv.min() == pytest.approx(-0.5)


@pytest.mark.parametrize("lines", ["mtllib a.mtl\nmtllib b.mtl", "mtllib a.mtl b.mtl"])
def test_two_libraries_of_materials_are_refused(tmp_path, lines):
    """Of two, one was read, and parts with materials of the other were grey."""
    path = obj(tmp_path, material="")
    (tmp_path / "b.mtl").write_text("newmtl n\nKd 0 1 0\n")
    path.write_text(path.read_text().replace("mtllib a.mtl", lines))
    with pytest.raises(
        MeshError, match=r"expected one library of materials \(mtllib\), got a\.mtl, b\.mtl; join them"
    ):
        load_mesh(path, unit="m")


def test_a_texture_of_16_bits_of_grey_is_not_cut_off(tmp_path):
    path = obj(tmp_path)
    grey = np.array([[65535, 32768], [16384, 0]], np.uint16)
    Image.fromarray(grey).save(tmp_path / "my texture.png")
    texture = load_mesh(path, unit="m").parts[0].texture
    np.testing.assert_allclose(texture[..., 0], grey / 65535.0, atol=0.5 / 255.0)


@pytest.mark.parametrize("kind", ["ushort red", "uchar diffuse_red"])
def test_colours_of_a_ply_that_the_reader_takes_for_others_are_refused(tmp_path, kind):
    rest = [kind.replace("red", name) for name in ("red", "green", "blue")]
    properties = "".join(f"property {each}\n" for each in ("float x", "float y", "float z", *rest))
    (tmp_path / "a.ply").write_text(
        f"ply\nformat ascii 1.0\nelement vertex 3\n{properties}element face 1\nproperty list uchar int vertex_indices\nend_header\n"
        "0 0 0 9 9 9\n1 0 0 9 9 9\n0 0 2 9 9 9\n3 0 1 2\n"
    )
    with pytest.raises(MeshError, match=rf"as uchar or float properties red, green and blue, got {kind}"):
        load_mesh(tmp_path / "a.ply", unit="m")


@pytest.mark.parametrize(
    "change",
    [
        {"textures": [{"source": 0, "sampler": 7}]},
        {"samplers": [3], "textures": [{"source": 0, "sampler": 0}]},
    ],
)
def test_a_sampler_that_is_none_is_one_error(tmp_path, change):
    (tmp_path / "a.png").write_bytes(png())
    file = gltf(tmp_path / "a.gltf", pbr(**TEXTURED), "a.png")
    file.write_text(json.dumps(json.loads(file.read_text()) | change))
    with pytest.raises(MeshError, match=r"cannot read .*a\.gltf as a mesh \(glTF: "):
        load_mesh(file)
