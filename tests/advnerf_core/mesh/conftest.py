import numpy as np
import pytest

from advnerf_core.geometry import Pinhole, make_transform, rotation_x, rotation_z
from advnerf_core.objects.mesh.engine import MeshEngineError, engine
from advnerf_core.objects.mesh.field import MeshField
from advnerf_core.objects.mesh.surface import TexturedMesh, sphere, unwrapped


@pytest.fixture(scope="session", autouse=True)
def mitsuba_works():
    try:
        engine()
    except MeshEngineError as error:
        pytest.skip(str(error))


# Neither square pixels nor a centred axis: a mistake in either shows.
PINHOLE = Pinhole(80, 40, 60.0, 55.0, 43.0, 17.0)
POSE = make_transform(rotation_z(0.3) @ rotation_x(0.4), [0.1, -0.2, 1.6])


def coloured_sphere(subdivisions: int = 2, resolution: int = 64) -> TexturedMesh:
    """A sphere whose colours are a smooth function of the place: nothing jumps where its charts meet."""
    mesh = unwrapped(sphere(0.4, (0.5, 0.5, 0.5), subdivisions), resolution)
    height, width = mesh.charts.shape
    total, count = np.zeros((height, width, 3)), np.zeros((height, width, 1))
    a, b = np.meshgrid(np.linspace(0, 1, 40), np.linspace(0, 1, 40))
    weights = np.stack([1 - a - b, a, b], axis=-1)[a + b <= 1.0]
    places = np.einsum("nk,fkc->fnc", weights, mesh.corners).reshape(-1, 3)
    texels = np.floor(np.einsum("nk,fkc->fnc", weights, mesh.texels).reshape(-1, 2)).astype(int)
    colours = 0.5 + 0.4 * np.sin(places @ np.array([[4.0, 0.0, 1.0], [0.0, 5.0, 2.0], [3.0, 1.0, 4.0]]))
    np.add.at(total, (texels[:, 1], texels[:, 0]), colours)
    np.add.at(count, (texels[:, 1], texels[:, 0]), 1.0)
    known = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    for _ in range(6):  # spread outward: texels at the rim are read by their neighbours
        around = np.stack([np.roll(known, (dy, dx), (0, 1)) for dy in (-1, 0, 1) for dx in (-1, 0, 1)])
        sums, counts = np.nansum(around, axis=0), (~np.isnan(around)).sum(axis=0)
        known = np.where(np.isnan(known), np.where(counts > 0, sums / np.maximum(counts, 1), np.nan), known)
    return mesh.with_texture(np.nan_to_num(known, nan=0.5).astype(np.float32))


@pytest.fixture(scope="session")
def ball() -> MeshField:
    return MeshField(coloured_sphere(), POSE)
