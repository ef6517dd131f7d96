"""A world of your own in one file: a warehouse that numpy draws by casting rays at boxes, and a car that steers.

    .venv/bin/advnerf scene world check examples/world_warehouse.py:Warehouse
    .venv/bin/advnerf experiment run examples/warehouse.experiment.yaml --setting demo --folder runs/warehouse

Metres, radians, seconds; the world's z points up, cameras have OpenCV axes (x right, y down, z forward). docs/worlds.md says what a world must have.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import TracebackType

import numpy as np

from advnerf_core.geometry import Array, Pinhole, VehicleState, camera_mount, look_at, planar_pose
from hardware.worlds.fitting import path_through
from hardware.worlds.paths import ReferencePath, Segment
from hardware.worlds.world import Box, CarDescription, Depth, Rgb, Traits, WorldDescription

HALL_M = (8.0, 5.0, 4.0)  # half of its length, half of its width, its height
WHEELBASE_M, WHEEL_LIMIT_RAD, HALF_LANE_M = 0.5, 0.5, 0.6
# What the car's body covers, ahead of the rear axle and to both sides.
BODY_M = [(x, y) for x in (-0.15, 0.3, 0.7) for y in (-0.25, 0.25)]
SUBSTEP_S = 0.01
# Shelves in the middle, pallets and crates at the walls: x0, x1, y0, y1, height.
BOXES = (
    (-3.8, -1.4, -1.5, -0.4, 2.6), (-0.8, 1.2, -1.5, -0.4, 2.2), (1.8, 3.8, -1.5, -0.4, 2.8), (-3.8, -1.0, 0.4, 1.5, 2.4),
    (-0.4, 3.8, 0.4, 1.5, 2.0), (-7.8, -7.0, -2.0, 2.0, 1.2), (7.0, 7.8, -1.6, -0.2, 1.6), (7.2, 7.9, 1.0, 3.4, 2.2),
    (-6.0, -4.4, 4.3, 4.9, 1.0), (-2.0, -0.6, 4.2, 4.9, 1.8), (1.4, 3.2, 4.3, 4.9, 0.9), (-3.0, -1.6, -4.9, -4.3, 0.8),
    (0.6, 1.8, -4.9, -4.4, 1.5), (-7.6, -6.6, -4.7, -3.9, 1.1), (6.2, 7.6, -4.9, -4.5, 0.7),
)  # fmt: skip


@dataclass(frozen=True)
class WarehouseConfig:
    """What can be changed with ``--set world.speed_mps=1``, or in an experiment's section ``world``.

    Attributes:
        width: Width of the driving camera's image [px].
        height: Its height [px].
        speed_mps: Speed of the drives [m/s].
        steering_lag_s: Time constant with which the wheels follow their command [s]; the attack does not know it.
        seed: Of the colours.
    """

    width: int = 336
    height: int = 188
    speed_mps: float = 1.2
    steering_lag_s: float = 0.05
    seed: int = 4


class Warehouse:
    """A hall of shelves; a `hardware.worlds.world.World`. There is nothing to open: numpy draws it."""

    Config = WarehouseConfig
    traits = Traits(unseen=("steering_lag_s",))  # another lag needs no new photographs

    def __init__(self, config: WarehouseConfig) -> None:
        self.config = config
        self.camera_pinhole = centred_pinhole(config.width, config.height, fov_deg=88.0)
        self.photo_pinhole = centred_pinhole(400, 240, fov_deg=90.0)
        self.T_car_from_camera = camera_mount(0.4, 0.0, 0.5, pitch_down_rad=math.radians(10.0))
        listed = np.array(BOXES)
        self._low = np.column_stack([listed[:, 0], listed[:, 2], np.zeros(len(listed))])  # [N, 3]
        self._high = np.column_stack([listed[:, 1], listed[:, 3], listed[:, 4]])
        rng = np.random.default_rng(config.seed)
        count = len(listed) + 1  # the last one is the hall
        self._base = rng.uniform(0.25, 0.95, (count, 3))
        self._waves = rng.normal(
            0.0, 0.5, (count, 3, 3)
        )  # of each colour channel: periods along x, y, z [1/m]
        self._phase = rng.uniform(0.0, 1.0, (count, 3))
        self.reset(0.0, -3.0, 0.0)

    def describe(self) -> WorldDescription:
        """A closed loop round the shelves, and a way past them to the wall, told apart by a one-hot goal."""
        x = np.linspace(-4.0, 6.5, 43)
        bend = np.clip((x - 1.0) / 4.0, 0.0, 1.0)
        dock = np.column_stack([x, -3.0 - 0.6 * bend**2 * (3.0 - 2.0 * bend)])
        side: Segment = ("line", 8.0)
        front: Segment = ("line", 3.0)
        corner: Segment = ("arc", 1.5, 0.5 * math.pi)
        half_x, half_y = HALL_M[:2]
        return WorldDescription(
            paths={
                "loop": ReferencePath(
                    (-4.0, -3.0, 0.0), (side, corner, front, corner) * 2, goal=(1.0, 0.0), closed=True
                ),
                "dock": path_through(dock, goal=(0.0, 1.0)),
            },
            off_track_m=HALF_LANE_M,
            car=CarDescription(
                "ackermann", self.config.speed_mps, (-WHEEL_LIMIT_RAD, WHEEL_LIMIT_RAD), WHEELBASE_M
            ),
            camera=self.camera_pinhole,
            T_car_from_camera=self.T_car_from_camera,
            box=Box((-half_x, -half_y, 0.0), HALL_M),
            road_edge=(
                np.array(
                    [
                        (-half_x, -half_y),
                        (half_x, -half_y),
                        (half_x, half_y),
                        (-half_x, half_y),
                        (-half_x, -half_y),
                    ]
                ),
            ),
        )

    def photo_poses(self, count: int, rng: np.random.Generator) -> list[Array]:
        """About the paths at the driving camera's height, turned a little; every fifth one from above, looking across the hall."""
        paths, poses = list(self.describe().paths.values()), []
        for index in range(count):
            path = paths[index % len(paths)]
            x, y, yaw = path.pose_at(float(rng.uniform(0.0, path.length_m)))
            if index % 5 == 4:
                poses.append(
                    look_at(
                        [x, y, rng.uniform(1.5, 3.0)], [rng.uniform(-6.0, 6.0), -y, rng.uniform(0.0, 1.0)]
                    )
                )
                continue
            aside = float(rng.uniform(-0.6, 0.6))
            car = planar_pose(
                x - aside * math.sin(yaw), y + aside * math.cos(yaw), yaw + float(rng.normal(0.0, 0.4))
            )
            poses.append(
                car @ camera_mount(0.4, 0.0, 0.5 + float(rng.uniform(-0.1, 0.3)), math.radians(10.0))
            )
        return poses

    @property
    def state(self) -> VehicleState:
        """True pose of the rear axle, speed and wheel angle."""
        x, y, yaw = self._pose
        return VehicleState(x, y, yaw, self._speed_mps, self._wheel_rad)

    @property
    def blocked(self) -> bool:
        """Whether the car stands against a box or a wall."""
        return not self._fits(*self._wanted)

    def reset(self, x_m: float, y_m: float, yaw_rad: float) -> VehicleState:
        """Put the car down at rest, its wheels straight."""
        self._pose = self._wanted = (float(x_m), float(y_m), math.remainder(yaw_rad, 2.0 * math.pi))
        self._speed_mps = self._wheel_rad = 0.0
        return self.state

    def step(self, wheel_rad: float, speed_mps: float, duration_s: float) -> VehicleState:
        """Hold a wheel angle [rad, left positive] and a speed [m/s] for a while; a kinematic bicycle whose wheels lag."""
        count = max(round(duration_s / SUBSTEP_S), 1)
        dt_s = duration_s / count
        target = min(max(wheel_rad, -WHEEL_LIMIT_RAD), WHEEL_LIMIT_RAD)
        follows = -math.expm1(-dt_s / self.config.steering_lag_s) if self.config.steering_lag_s > 0.0 else 1.0
        for _ in range(count):
            self._wheel_rad += follows * (target - self._wheel_rad)
            turn = speed_mps * dt_s * math.tan(self._wheel_rad) / WHEELBASE_M
            x, y, yaw = self._pose
            course = yaw + 0.5 * turn
            moved = (
                x + speed_mps * dt_s * math.cos(course),
                y + speed_mps * dt_s * math.sin(course),
                yaw + turn,
            )
            self._wanted = moved
            self._speed_mps = speed_mps if self._fits(*moved) else 0.0
            if not self._speed_mps:
                break
            self._pose = (moved[0], moved[1], math.remainder(moved[2], 2.0 * math.pi))
        return self.state

    def observe(self, depth: bool = True) -> tuple[Rgb, Depth | None]:
        """What the driving camera sees: colours ``[H, W, 3]`` and planar depth ``[H, W]`` [m]."""
        return self.observe_at(*self._pose, depth=depth)

    def observe_at(
        self, x_m: float, y_m: float, yaw_rad: float, depth: bool = True
    ) -> tuple[Rgb, Depth | None]:
        """The same from another pose of the car."""
        rgb, depth_m = self._cast(
            planar_pose(x_m, y_m, yaw_rad) @ self.T_car_from_camera, self.camera_pinhole
        )
        return rgb, depth_m if depth else None

    def photograph(self, T_world_from_camera: Array) -> Rgb:
        """A photograph ``[H, W, 3]`` with ``photo_pinhole``."""
        return self._cast(T_world_from_camera, self.photo_pinhole)[0]

    def __enter__(self) -> Warehouse:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        pass

    def _fits(self, x_m: float, y_m: float, yaw_rad: float) -> bool:
        c, s = math.cos(yaw_rad), math.sin(yaw_rad)
        body = np.array([(x_m + c * u - s * v, y_m + s * u + c * v) for u, v in BODY_M])[:, None]
        inside = ((body > self._low[:, :2]) & (body < self._high[:, :2])).all(axis=-1)
        return not inside.any() and bool((np.abs(body) < HALL_M[:2]).all())

    def _cast(self, T_world_from_camera: Array, pinhole: Pinhole) -> tuple[Rgb, Depth]:
        """Colours and planar depth of what each pixel's ray meets first."""
        eye, R = T_world_from_camera[:3, 3, None, None], T_world_from_camera[:3, :3]
        # Of unit planar depth, so that the distance along them is planar depth. Axes first: numpy then reduces whole rows.
        rays = np.ascontiguousarray(np.moveaxis(pinhole.directions() @ R.T, -1, 0))
        rays = np.where(np.abs(rays) < 1e-9, 1e-9, rays)
        low, high = (np.array(end)[:, None, None] for end in ((-HALL_M[0], -HALL_M[1], 0.0), HALL_M))
        # Of the hall the inside is seen: the nearest of the walls ahead.
        ends = np.maximum((low - eye) / rays, (high - eye) / rays)
        depth, axis = ends.min(axis=0), ends.argmin(axis=0)
        index = np.full(depth.shape, len(self._low))
        for number, box in enumerate(np.stack([self._low, self._high], axis=1)):
            one, other = (box[..., None, None] - eye) / rays
            enter, leave = np.minimum(one, other), np.maximum(one, other).min(axis=0)
            first = enter.max(axis=0)
            hit = (first < leave) & (first > 0.0) & (first < depth)
            depth, index = np.where(hit, first, depth), np.where(hit, number, index)
            axis = np.where(hit, enter.argmax(axis=0), axis)
        points = np.moveaxis(eye + depth * rays, 0, -1)
        wave = np.einsum("hwk,hwck->hwc", points, self._waves[index]) + self._phase[index]
        light = np.array([0.75, 0.9, 1.0])[axis]  # walls along y, walls along x, floor and ceiling
        colour = self._base[index] * (0.75 + 0.25 * np.sin(2.0 * math.pi * wave)) * light[..., None]
        return np.rint(255.0 * colour).astype(np.uint8), depth.astype(np.float32)


def centred_pinhole(width: int, height: int, fov_deg: float) -> Pinhole:
    """Square pixels, the principal point in the middle."""
    focal_px = 0.5 * width / math.tan(0.5 * math.radians(fov_deg))
    return Pinhole(width, height, focal_px, focal_px, 0.5 * width, 0.5 * height)
