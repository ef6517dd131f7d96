"""Plain torch rendering of a splat, pixel by pixel over all Gaussians in order: slow, and what the kernels are compared with.

What is drawn is decided by float32 arithmetic in the order of the kernels, so that both make the same decisions.
"""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from advnerf_core.fields.spherical_harmonics import spherical_harmonics
from advnerf_core.geometry import Pinhole
from advnerf_core.splats.gaussians import COLOUR_OFFSET, GaussianSplats
from advnerf_core.splats.projection import DILATION_PX2, LEAST_TRANSMITTANCE, MOST_ALPHA, View, drawn_within

Projected = dict[str, Tensor]


def render_reference(
    splats: GaussianSplats,
    T_world_from_camera: ArrayLike,
    pinhole: Pinhole,
    near_m: float,
    behind: ArrayLike = (0.0, 0.0, 0.0),
) -> dict[str, Tensor]:
    """Render one view.

    Args:
        T_world_from_camera: Pose ``[4, 4]``.
        near_m: Gaussians whose centres are nearer are left out [m].
        behind: Colour ``[3]`` behind everything.

    Returns:
        ``rgb [H, W, 3]``, ``alpha`` and ``depth_m`` ``[H, W]``: see `SplatRenderer`.
    """
    view = View.of(T_world_from_camera, pinhole, near_m)
    found = _projected(splats, view, pinhole)
    order = torch.argsort(found["z"], stable=True)
    found = {name: value[order] for name, value in found.items()}
    rows, columns = torch.meshgrid(torch.arange(pinhole.height), torch.arange(pinhole.width), indexing="ij")
    x, y = (each.reshape(-1).to(torch.float32) + 0.5 for each in (columns, rows))
    through = torch.ones(len(x), dtype=torch.float64)
    rgb, depth = torch.zeros(len(x), 3, dtype=torch.float64), torch.zeros(len(x), dtype=torch.float64)
    for n in range(len(found["z"])):
        dx, dy = x - found["u"][n], y - found["v"][n]
        q = (found["a"][n] * dx * dx + found["c"][n] * dy * dy) + found["b2"][n] * dx * dy
        alpha = (found["opacity"][n].double() * torch.exp(-0.5 * q.double())).clamp(max=MOST_ALPHA)
        drawn = (q >= 0.0) & (q <= found["within"][n]) & (through >= LEAST_TRANSMITTANCE)
        weight = torch.where(drawn, through * alpha, 0.0)
        rgb += weight[:, None] * found["colour"][n]
        depth += weight * found["z"][n]
        through = through - weight
    shape = (pinhole.height, pinhole.width)
    opacity = 1.0 - through
    rgb = (rgb + through[:, None] * torch.as_tensor(np.asarray(behind, np.float64))).clamp(max=1.0)
    expected = torch.where(opacity > 1e-3, depth / opacity, torch.inf)
    return {
        "rgb": rgb.reshape(*shape, 3),
        "alpha": opacity.reshape(shape),
        "depth_m": expected.reshape(shape),
    }


def _projected(splats: GaussianSplats, view: View, pinhole: Pinhole) -> Projected:
    """The Gaussians in front of the camera on the image plane."""
    w = torch.from_numpy(view.T_camera_from_world)
    fx, fy, cx, cy = (
        torch.tensor(value, dtype=torch.float32) for value in (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy)
    )
    m = torch.from_numpy(splats.means_m).unbind(-1)
    x, y, z = (((w[i, 0] * m[0] + w[i, 1] * m[1]) + w[i, 2] * m[2]) + w[i, 3] for i in range(3))
    within = torch.from_numpy(drawn_within(splats.opacities))
    tx = torch.minimum(torch.maximum(x / z, view.limits[0]), view.limits[1])
    ty = torch.minimum(torch.maximum(y / z, view.limits[2]), view.limits[3])
    jx, jy = fx / z, fy / z
    jxz, jyz = jx * tx, jy * ty
    a = [jx * w[0, k] - jxz * w[2, k] for k in range(3)]
    b = [jy * w[1, k] - jyz * w[2, k] for k in range(3)]
    s = torch.from_numpy(splats.covariances()).unbind(-1)
    rows = ((s[0], s[1], s[2]), (s[1], s[3], s[4]), (s[2], s[4], s[5]))
    sa = [(row[0] * a[0] + row[1] * a[1]) + row[2] * a[2] for row in rows]
    sb = [(row[0] * b[0] + row[1] * b[1]) + row[2] * b[2] for row in rows]
    dilation = torch.tensor(DILATION_PX2, dtype=torch.float32)
    xx = ((a[0] * sa[0] + a[1] * sa[1]) + a[2] * sa[2]) + dilation
    xy = (b[0] * sa[0] + b[1] * sa[1]) + b[2] * sa[2]
    yy = ((b[0] * sb[0] + b[1] * sb[1]) + b[2] * sb[2]) + dilation
    det = xx * yy - xy * xy
    seen = (z > view.near_m) & (det > 0.0) & (within > 0.0)
    offset = torch.from_numpy(splats.means_m).double() - torch.from_numpy(view.centre_m)
    direction = offset / offset.norm(dim=1, keepdim=True).clamp(min=1e-12)
    basis = spherical_harmonics(direction, splats.bands)
    colour = torch.einsum("nk,nkc->nc", basis, torch.from_numpy(splats.harmonics).double()) + COLOUR_OFFSET
    found = {
        "u": (fx * x) / z + cx,
        "v": (fy * y) / z + cy,
        "a": yy / det,
        "b2": (-2.0 * xy) / det,
        "c": xx / det,
        "z": z,
        "opacity": torch.from_numpy(splats.opacities),
        "within": within,
        "colour": colour.clamp(min=0.0),
    }
    return {name: value[seen] for name, value in found.items()}
