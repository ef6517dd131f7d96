"""Every number of the simulated lab: room, track, cameras, board, monitor and the car's true (not nominal) behaviour."""

from __future__ import annotations

import math
from typing import Any

from pydantic import Field, ValidationInfo, field_validator, model_validator

from advnerf_core.geometry import Array, Pinhole, camera_mount, make_transform, rotation_z
from advnerf_core.strict import Angle, AngularRate, LagS, LengthM, RightAngleRad, SpeedMps, StrictModel

Colour = tuple[float, float, float]
Matrix3 = tuple[Colour, Colour, Colour]


class RoomConfig(StrictModel):
    """A square room centred at the world's origin.

    Attributes:
        side_m: Inner side of the room [m].
        height_m: Height of the ceiling [m].
        seed: Seed of the procedural textures.
    """

    side_m: float = Field(default=8.0, ge=6.0)
    height_m: float = Field(default=2.5, ge=1.5)
    seed: int = 7


class TrackConfig(StrictModel):
    """The closed line of tape, centred at the origin and driven counter-clockwise.

    Attributes:
        side_m: Side of the square of tape centre lines [m].
        corner_radius_m: Radius of its corners [m].
        tape_width_m: Width of the tape [m].
        tape_rgb: Colour of the tape, 0..1.
    """

    side_m: float = Field(default=4.0, gt=0.0)
    corner_radius_m: float = Field(default=1.1, gt=0.0)
    tape_width_m: float = Field(default=0.05, gt=0.0)
    tape_rgb: Colour = (0.06, 0.78, 0.25)

    @model_validator(mode="after")
    def _corners_fit(self) -> TrackConfig:
        if 2.0 * self.corner_radius_m > self.side_m:
            raise ValueError(
                f"expected corner_radius_m <= side_m / 2 = {self.side_m / 2}, got {self.corner_radius_m}"
            )
        return self


class PhotoConfig(StrictModel):
    """A camera without distortion that photographs a scene for learning.

    Attributes:
        width: Image width [px].
        height: Image height [px].
        horizontal_fov_deg: Horizontal field of view [deg]; fixes fx = fy.
    """

    width: int = Field(default=640, gt=0)
    height: int = Field(default=360, gt=0)
    horizontal_fov_deg: float = Field(default=90.0, gt=0.0, lt=170.0)

    @property
    def pinhole(self) -> Pinhole:
        """Intrinsics with a centred principal point and square pixels."""
        focal_px = 0.5 * self.width / math.tan(0.5 * math.radians(self.horizontal_fov_deg))
        return Pinhole(self.width, self.height, focal_px, focal_px, 0.5 * self.width, 0.5 * self.height)


class CameraConfig(PhotoConfig):
    """The driving camera: like the left eye of a ZED at half VGA; 366 pixels wide for the paper's figure.

    Attributes:
        rate_hz: Frame rate of the live camera [Hz].
        x_m: Position ahead of the rear axle [m].
        y_m: Position left of the car's middle [m].
        z_m: Height above the floor [m].
        pitch_down_rad: Angle of the optical axis below the horizon [rad].
    """

    width: int = Field(default=336, gt=0)
    height: int = Field(default=188, gt=0)
    horizontal_fov_deg: float = Field(default=88.0, gt=0.0, lt=170.0)
    rate_hz: float = Field(default=10.0, gt=0.0)
    x_m: LengthM = 0.30
    y_m: LengthM = 0.0
    z_m: LengthM = Field(default=0.20, gt=0.0)
    pitch_down_rad: RightAngleRad = math.radians(10.0)

    @property
    def T_car_from_camera(self) -> Array:
        """Mounting pose ``[4, 4]`` of the camera on the car."""
        return camera_mount(self.x_m, self.y_m, self.z_m, self.pitch_down_rad)


class PhoneConfig(PhotoConfig):
    """The camera that photographs the room: another field of view, resolution and colour response.

    Attributes:
        colour_matrix: Mixing of the driving camera's linearised channels into the phone's, row by row.
        gamma: Exponent of the phone's tone curve relative to the driving camera's.
        mount_height_m: Range of heights when the phone rides on the car [m].
        walk_height_m: Range of heights when the phone is hand-held [m].
    """

    width: int = Field(default=640, gt=0)
    height: int = Field(default=480, gt=0)
    horizontal_fov_deg: float = Field(default=65.0, gt=0.0, lt=170.0)
    colour_matrix: Matrix3 = ((0.99, 0.05, -0.01), (0.02, 0.95, 0.01), (0.00, 0.04, 0.89))
    gamma: float = Field(default=0.95, gt=0.0)
    mount_height_m: tuple[LengthM, LengthM] = (0.19, 0.32)
    walk_height_m: tuple[LengthM, LengthM] = (0.9, 1.7)


class PanelConfig(StrictModel):
    """A flat upright panel that motion capture tracks: the board or the monitor's screen.

    Attributes:
        x_m: Centre of the face [m].
        y_m: Centre of the face [m].
        z_m: Centre of the face [m].
        yaw_rad: Heading of the face's outward normal [rad].
        width_m: Width of the face [m].
        height_m: Height of the face [m].
        thickness_m: Depth of the box behind the face [m].
        rgb: Plain colour of the face, 0..1.
    """

    x_m: float
    y_m: float
    z_m: float
    yaw_rad: Angle
    width_m: LengthM = Field(gt=0.0)
    height_m: LengthM = Field(gt=0.0)
    thickness_m: LengthM = Field(gt=0.0)
    rgb: Colour

    @property
    def T_world_from_face(self) -> Array:
        """Pose ``[4, 4]``: origin in the face's centre, x out of the face, z up."""
        return make_transform(rotation_z(self.yaw_rad), [self.x_m, self.y_m, self.z_m])


class MonitorOpticsConfig(StrictModel):
    """Optics from monitor to camera; see `hardware.worlds.lab.monitor`. The default is the identity.

    Attributes:
        gamma: Exponent from shown value to light, by channel.
        mixing: Light of the screen's channels (columns) in the camera's (rows), at full drive and straight on.
        glare: Light of the room reflected by the glass, in the camera's channels.
        falloff: Power of the cosine of the viewing angle with which the panel dims.
        response: The camera's response is light to the power of one over this.
    """

    gamma: Colour = (1.0, 1.0, 1.0)
    mixing: Matrix3 = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))
    glare: Colour = (0.0, 0.0, 0.0)
    falloff: float = Field(default=0.0, ge=0.0)
    response: float = Field(default=1.0, gt=0.0)

    @model_validator(mode="after")
    def _possible(self) -> MonitorOpticsConfig:
        if min(self.gamma) <= 0.0 or min(self.glare) < 0.0:
            raise ValueError(f"expected gamma > 0 and glare >= 0, got {self.gamma} and {self.glare}")
        return self

    @classmethod
    def office(cls) -> MonitorOpticsConfig:
        """An ordinary IPS monitor under ceiling lamps before a camera with sRGB-like response."""
        return cls(
            gamma=(2.30, 2.16, 2.42),
            mixing=((0.66, 0.10, 0.02), (0.06, 0.72, 0.07), (0.01, 0.09, 0.68)),
            glare=(0.015, 0.016, 0.019),
            falloff=1.4,
            response=2.2,
        )


class CarConfig(StrictModel):
    """A RACECAR/J-sized car: its nominal (assumed by the driver) and its true behaviour.

    Attributes:
        wheelbase_m: Distance between the axles [m].
        body_length_m: Length of the body, centred between the axles [m].
        body_width_m: Width of the body [m].
        body_height_m: Height of the body [m].
        speed_mps: Cruising speed of the experiments [m/s].
        nominal_servo_gain: Servo position per radian of steering that the driver assumes.
        nominal_servo_offset: Servo position for straight ahead that the driver assumes.
        servo_min: Smallest servo position that the driver sends.
        servo_max: Largest servo position that the driver sends.
        nominal_erpm_gain: Electrical rpm per m/s that the driver assumes.
        min_erpm: Speed commands below this stop the motor (VESC ``s_pid_min_erpm``).
        true_servo_gain: Servo position per radian of the real linkage: 2.5 % off.
        true_servo_offset: Servo position of the real straight-ahead.
        true_erpm_gain: Electrical rpm per m/s of the real gearing and tyres: 2 % off.
        steering_lag_s: Time constant of the wheel angle [s].
        steering_slew_radps: Greatest rate of the wheel angle [rad/s].
        motor_lag_s: Time constant of the speed under speed control [s].
        drag_stop_lag_s: Time constant of the speed with the motor's phases shorted (duty 0) [s].
        friction_mps2: Deceleration when coasting [m/s2].
        acceleration_per_amp_mps2: Acceleration, or deceleration when braking, per ampere of motor current [m/s2/A].
        grip_mps2: Greatest acceleration or deceleration that the tyres hold [m/s2].
        command_delay_s: From image capture to the command reaching the actuators in the synchronous lab [s].
    """

    wheelbase_m: LengthM = Field(default=0.25, gt=0.0)
    body_length_m: LengthM = Field(default=0.508, gt=0.0)
    body_width_m: LengthM = Field(default=0.292, gt=0.0)
    body_height_m: LengthM = Field(default=0.195, gt=0.0)
    speed_mps: SpeedMps = Field(default=0.8, gt=0.0)
    nominal_servo_gain: float = -1.2135
    nominal_servo_offset: float = 0.5304
    servo_min: float = 0.15
    servo_max: float = 0.85
    nominal_erpm_gain: float = Field(default=4614.0, gt=0.0)
    min_erpm: float = Field(default=900.0, ge=0.0)
    true_servo_gain: float = -1.2135 * 1.025
    true_servo_offset: float = 0.5304 + 0.003
    true_erpm_gain: float = Field(default=4614.0 * 1.02, gt=0.0)
    steering_lag_s: LagS = Field(default=0.06, gt=0.0)
    steering_slew_radps: AngularRate = Field(default=3.2, gt=0.0)
    motor_lag_s: LagS = Field(default=0.15, gt=0.0)
    drag_stop_lag_s: LagS = Field(default=0.20, gt=0.0)
    friction_mps2: float = Field(default=0.6, ge=0.0)
    acceleration_per_amp_mps2: float = Field(default=0.16, ge=0.0)
    grip_mps2: float = Field(default=6.0, gt=0.0)
    command_delay_s: LagS = Field(default=0.05, ge=0.0)

    def servo_from_steering(self, steering_rad: float) -> float:
        """Servo position the driver sends for a steering angle: nominal mapping, clipped to the servo's limits."""
        servo = self.nominal_servo_gain * steering_rad + self.nominal_servo_offset
        return min(max(servo, self.servo_min), self.servo_max)

    def erpm_from_speed(self, speed_mps: float) -> float:
        """Electrical rpm the driver sends for a speed by the nominal gain."""
        return self.nominal_erpm_gain * speed_mps


class LabConfig(StrictModel):
    """The whole simulated lab; the defaults are the lab of the experiments.

    Attributes:
        room: Walls and textures.
        track: Tape on the floor.
        camera: Driving camera.
        phone: Camera that photographs the room.
        board: Green board at the bottom right corner of the track, motion-capture subject "board".
        monitor: 27-inch screen at the top right corner, motion-capture subject "monitor".
        monitor_optics: Optics from the monitor to the cameras.
        car: Vehicle.
        shadows: Whether the furniture casts shadows.
        supersampling: Images are drawn this many times larger per axis and averaged.
    """

    room: RoomConfig = RoomConfig()
    track: TrackConfig = TrackConfig()
    camera: CameraConfig = CameraConfig()
    phone: PhoneConfig = PhoneConfig()
    # Faces back down the bottom straight, turned 8 degrees towards its start.
    board: PanelConfig = PanelConfig(
        x_m=3.05,
        y_m=-1.80,
        z_m=0.52,
        yaw_rad=math.pi + math.radians(8.0),
        width_m=1.0,
        height_m=1.0,
        thickness_m=0.05,
        rgb=(0.20, 0.62, 0.28),
    )
    # The same place relative to the next corner, so that it faces back down the right-hand straight.
    monitor: PanelConfig = PanelConfig(
        x_m=1.75,
        y_m=3.15,
        z_m=0.38,
        yaw_rad=1.5 * math.pi + math.radians(8.0),
        width_m=0.5977,
        height_m=0.3362,
        thickness_m=0.04,
        rgb=(0.09, 0.10, 0.12),
    )
    monitor_optics: MonitorOpticsConfig = MonitorOpticsConfig()
    car: CarConfig = CarConfig()
    shadows: bool = True
    supersampling: int = Field(default=2, ge=1, le=4)

    @field_validator("board", "monitor", mode="before")
    @classmethod
    def _the_rest_as_it_is(cls, value: Any, info: ValidationInfo) -> Any:
        """A moved panel keeps the keys that were not given: ``--set lab.board.x_m=2.8``."""
        if not isinstance(value, dict):
            return value
        return {**cls.model_fields[info.field_name or ""].default.model_dump(), **value}

    @property
    def start_pose(self) -> tuple[float, float, float]:
        """Nominal start of the experiments, 2 m before the bottom right corner: x [m], y [m], yaw [rad]."""
        return 0.5 * self.track.side_m - self.track.corner_radius_m - 2.0, -0.5 * self.track.side_m, 0.0
