"""A simulator for tests, numpy only: a chequered floor with coloured posts and panels, drawn by casting rays, and a kinematic car.

It is served by ``hardware/worlds/servers/serve.py`` as any other, and imports nothing of this project.
"""

import math

import numpy as np

HALF_M, POST_HEIGHT_M = 14.0, 3.0
FAR_M = 60.0


def open_simulator(config, cameras):
    return FlatSimulator(config, cameras)


class FlatSimulator:
    def __init__(self, config, cameras):
        self._cameras = cameras
        self._speed = 0.0
        rng = np.random.default_rng(config["seed"])
        angles = np.linspace(0.0, 2.0 * np.pi, 24, endpoint=False)
        self._posts = np.column_stack(
            [11.0 * np.cos(angles), 11.0 * np.sin(angles), rng.uniform(0.2, 0.5, 24)]
        )
        self._colours = rng.uniform(40.0, 240.0, (24, 3))
        self._tiles = rng.uniform(60.0, 200.0, (64, 64, 3))
        self._panels, self._meshes = {}, {}
        self._pose = (0.0, 0.0, 0.0)

    def describe(self):
        angle = np.linspace(0.0, 2.0 * np.pi, 73)[:-1]
        return {"wheelbase_m": 0.5}, {"lane": np.column_stack([6.0 * np.cos(angle), 6.0 * np.sin(angle)])}

    def reset(self, x_m, y_m, yaw_rad):
        self._pose, self._speed = (x_m, y_m, math.remainder(yaw_rad, 2.0 * math.pi)), 0.0
        return self._state()

    def step(self, control, speed_mps, duration_s):
        x, y, yaw = self._pose
        turn = speed_mps * duration_s * math.tan(max(-0.5, min(0.5, control))) / 0.5
        chord = speed_mps * duration_s * (math.sin(0.5 * turn) / (0.5 * turn) if turn else 1.0)
        course = yaw + 0.5 * turn
        moved = (
            x + chord * math.cos(course),
            y + chord * math.sin(course),
            math.remainder(yaw + turn, 2.0 * math.pi),
        )
        self._pose, self._speed = moved, speed_mps
        return self._state()

    def _state(self):
        blocked = max(abs(self._pose[0]), abs(self._pose[1])) > HALF_M
        return {"state": [*self._pose, self._speed, 0.0], "blocked": blocked}, {}

    def add_panel(self, name, size_m, T_world_from_face=None, rgb=None):
        if size_m is None:
            self._panels.pop(name, None)
        else:
            self._panels[name] = (T_world_from_face.copy(), size_m, rgb.copy())
        return {}, {}

    def add_mesh(self, name, **arrays):
        self._meshes.pop(name, None)
        if arrays:
            self._meshes[name] = {key: array.copy() for key, array in arrays.items()}
        return {}, {}

    def render(self, camera, depth, T_world_from_camera):
        lens, T = self._cameras[camera], T_world_from_camera
        columns = (np.arange(lens["width"]) + 0.5 - lens["cx"]) / lens["fx"]
        rows = (np.arange(lens["height"]) + 0.5 - lens["cy"]) / lens["fy"]
        x, y = np.meshgrid(columns, rows)
        rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ T[:3, :3].T
        eye = T[:3, 3]
        with np.errstate(divide="ignore", invalid="ignore"):
            floor = np.where(rays[..., 2] < 0.0, -eye[2] / rays[..., 2], np.inf)
        floor[floor > FAR_M] = np.inf
        at = eye + np.where(np.isfinite(floor), floor, 0.0)[..., None] * rays
        tile = np.floor(at[..., :2]).astype(int) % 64
        sky = 150.0 + 60.0 * rays[..., 2:] / np.linalg.norm(rays, axis=-1, keepdims=True)
        rgb = np.where(np.isfinite(floor)[..., None], self._tiles[tile[..., 0], tile[..., 1]], sky)
        z, steep = floor, rays[..., 0] ** 2 + rays[..., 1] ** 2
        for (px, py, radius), colour in zip(self._posts, self._colours, strict=True):
            self._post(rgb, z, eye, rays, steep, px, py, radius, colour)
        for T_face, size, texture in self._panels.values():
            rgb, z = self._panel(rgb, z, eye, rays, T_face, size, texture)
        for mesh in self._meshes.values():
            self._mesh(rgb, z, lens, T, np.stack([x, y, np.ones_like(x)], axis=-1), mesh)
        found = {"rgb": np.rint(np.clip(rgb, 0.0, 255.0)).astype(np.uint8), "T_world_from_camera": T}
        if depth:
            found["depth"] = np.where(z < FAR_M, z, np.inf).astype("<f4")
        return {}, found

    def _post(self, rgb, z, eye, rays, steep, px, py, radius, colour):
        """A round post: the nearer crossing of a vertical cylinder."""
        ox, oy = eye[0] - px, eye[1] - py
        b = rays[..., 0] * ox + rays[..., 1] * oy
        root = b * b - steep * (ox * ox + oy * oy - radius * radius)
        met = (root > 0.0) & (b < 0.0)  # what lies behind is not seen
        hit = (-b[met] - np.sqrt(root[met])) / steep[met]
        height = eye[2] + hit * rays[met][:, 2]
        seen = (hit > 0.05) & (hit < z[met]) & (height > 0.0) & (height < POST_HEIGHT_M)
        met[met] = seen
        rgb[met] = colour * (0.6 + 0.4 * np.sin(9.0 * height[seen, None]) ** 2)
        z[met] = hit[seen]

    def _panel(self, rgb, z, eye, rays, T_face, size, texture):
        """A rectangle in the plane x = 0 of its frame, seen from x > 0; for a viewer its right is the frame's +y."""
        R = T_face[:3, :3]
        o, d = R.T @ (eye - T_face[:3, 3]), rays @ R
        with np.errstate(divide="ignore", invalid="ignore"):
            hit = np.where(d[..., 0] < 0.0, -o[0] / d[..., 0], np.inf)
        at = o + np.where(np.isfinite(hit), hit, 0.0)[..., None] * d
        u, v = at[..., 1] / size[0] + 0.5, 0.5 - at[..., 2] / size[1]
        seen = (hit > 0.05) & (hit < z) & (abs(u - 0.5) < 0.5) & (abs(v - 0.5) < 0.5)
        h, w = texture.shape[:2]
        column, row = np.clip((u * w).astype(int), 0, w - 1), np.clip((v * h).astype(int), 0, h - 1)
        return np.where(seen[..., None], texture[row, column], rgb), np.where(seen, hit, z)

    def _mesh(self, rgb, z, lens, T, rays, mesh):
        """Triangles, unlit, seen from the front: each is drawn where the pixels of its box hit it in front of all else."""
        seen = (mesh["corners_m"] - T[:3, 3]) @ T[:3, :3]
        texture = mesh["rgb"]
        h, w = texture.shape[:2]
        for corners, uv in zip(seen, mesh["uv"], strict=True):
            if corners[:, 2].min() < 0.05 or np.dot(np.cross(*np.diff(corners, axis=0)), corners[0]) >= 0.0:
                continue
            columns = corners[:, 0] / corners[:, 2] * lens["fx"] + lens["cx"]
            rows = corners[:, 1] / corners[:, 2] * lens["fy"] + lens["cy"]
            left, right = max(int(columns.min()), 0), min(int(columns.max()) + 1, lens["width"])
            top, bottom = max(int(rows.min()), 0), min(int(rows.max()) + 1, lens["height"])
            if left >= right or top >= bottom or abs(np.linalg.det(corners)) < 1e-15:
                continue
            box = np.s_[top:bottom, left:right]
            weights = rays[box] @ np.linalg.inv(corners)
            with np.errstate(divide="ignore", invalid="ignore"):
                hit = 1.0 / weights.sum(axis=-1)
            met = (weights >= 0.0).all(axis=-1) & (hit > 0.05) & (hit < z[box])
            at = (weights[met] * hit[met, None]) @ uv
            rgb[box][met] = texture[
                np.clip((at[:, 1] * h).astype(int), 0, h - 1), np.clip((at[:, 0] * w).astype(int), 0, w - 1)
            ]
            z[box][met] = hit[met]
