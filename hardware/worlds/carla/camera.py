"""A camera in CARLA's world that returns the picture of a given tick."""

from __future__ import annotations

import math
import threading
from typing import Any

from advnerf_core.geometry import Pinhole
from hardware.worlds.carla.config import RenderConfig
from hardware.worlds.carla.errors import CarlaError, CarlaFrameError
from hardware.worlds.carla.frames import CarlaPose
from hardware.worlds.carla.undo import Undo

RGB, DEPTH = "sensor.camera.rgb", "sensor.camera.depth"
# The pose that the server writes into a picture must equal the requested pose, up to single precision some kilometres from the origin.
POSITION_TOLERANCE_M, ANGLE_TOLERANCE_RAD = 5e-3, 1e-3
_KEPT = 8


class Mailbox:
    """The newest pictures by frame number. ``put`` is called in a thread of the client library, ``wait`` in the caller's."""

    def __init__(self) -> None:
        self._pictures: dict[int, Any] = {}
        self._came = threading.Condition()

    def put(self, picture: Any) -> None:
        """Store a picture."""
        with self._came:
            self._pictures[int(picture.frame)] = picture
            for old in sorted(self._pictures)[:-_KEPT]:
                del self._pictures[old]
            self._came.notify_all()

    def wait(self, frame: int, timeout_s: float) -> Any:
        """The picture of a frame; it stays in the mailbox.

        Raises:
            CarlaFrameError: No picture came in time; the message says whether the camera is silent or skipped this frame.
        """
        with self._came:
            if self._came.wait_for(lambda: frame in self._pictures, timeout_s):
                return self._pictures[frame]
            newest = max(self._pictures, default=None)
        if newest is None:
            came = "no picture at all: are the server's port for images (its port + 1) and its rendering in order?"
        elif newest > frame:
            came = f"frame {newest}: the server left this one out"
        else:
            came = f"nothing after frame {newest}: the server is too slow, or stands; raise server.frame_timeout_s if it is slow"
        raise CarlaFrameError(
            f"expected the picture of frame {frame} within {timeout_s:g} s of its tick, got {came}"
        )


class CarlaCamera:
    """One CARLA camera without distortion that can be moved to any pose.

    It is attached to nothing: a camera on a vehicle moves with suspension and terrain, and the drive needs
    the exact pose that the surrogate renders.

    Args:
        world: A ``carla.World``.
        library: The ``carla`` module.
        kind: `RGB` or `DEPTH`.
        pinhole: Size and focal length; the principal point must be in the middle, as CARLA supports no other.
        undo: Receives the action that removes the camera.

    Raises:
        CarlaError: The server does not have such a camera, or one of its attributes.

    Attributes:
        pose: Last requested pose.
        settled: Whether it has seen some ticks since it jumped.
    """

    def __init__(
        self,
        world: Any,
        library: Any,
        kind: str,
        pinhole: Pinhole,
        pose: CarlaPose,
        render: RenderConfig,
        undo: Undo,
    ) -> None:
        self.pinhole, self._library = pinhole, library
        self._mailbox = Mailbox()
        self.pose: CarlaPose = pose
        self.settled = False
        blueprint = camera_blueprint(world, kind, pinhole, render)
        try:
            self._actor = world.spawn_actor(blueprint, pose.to_transform(library))
        except RuntimeError as error:
            raise CarlaError(f"expected to put a camera ({kind}) into CARLA's world, got: {error}") from error
        undo.push(f"removing the camera {kind}", self._actor.destroy)
        undo.push(f"stopping the camera {kind}", self._actor.stop)
        self._actor.listen(self._mailbox.put)

    def aim(self, pose: CarlaPose, jump: bool) -> None:
        """Move the camera; the next tick's picture is from there. ``jump`` if the move does not continue the camera's motion."""
        self.pose, self.settled = pose, self.settled and not jump
        self._actor.set_transform(pose.to_transform(self._library))

    def picture(self, frame: int, timeout_s: float) -> Any:
        """The raw picture (``carla.Image``) of a frame, from the requested pose.

        Raises:
            CarlaFrameError: No picture came in time, or it was taken from another pose.
        """
        image = self._mailbox.wait(frame, timeout_s)
        taken = CarlaPose.of(image.transform)
        apart_m, turned = self.pose.distance_to(taken)
        if apart_m > POSITION_TOLERANCE_M or turned > ANGLE_TOLERANCE_RAD:
            raise CarlaFrameError(
                f"expected the picture of frame {frame} from {self.pose}, got one from {taken}: {apart_m:.3f} m and "
                f"{math.degrees(turned):.2f} degrees away"
            )
        return image


def camera_blueprint(world: Any, kind: str, pinhole: Pinhole, render: RenderConfig) -> Any:
    """A blueprint with all attributes set.

    Raises:
        CarlaError: The server lacks this camera or one of the attributes.
    """
    try:
        blueprint = world.get_blueprint_library().find(kind)
    except (RuntimeError, IndexError) as error:
        raise CarlaError(f"expected the blueprint {kind} on the server, got: {error}") from error
    fov_deg = math.degrees(2.0 * math.atan(0.5 * pinhole.width / pinhole.fx))
    wanted = {
        "image_size_x": str(pinhole.width),
        "image_size_y": str(pinhole.height),
        "fov": f"{fov_deg:.9g}",
        "sensor_tick": "0.0",
    }
    if kind == RGB:
        wanted |= render.camera_attributes
        if render.exposure == "fixed":
            bright = render.exposure_bright or _upper_exposure(blueprint)
            wanted |= {
                "exposure_mode": "histogram",
                "exposure_min_bright": f"{bright:g}",
                "exposure_max_bright": f"{bright:g}",
            }
    for name, value in wanted.items():
        if not blueprint.has_attribute(name):
            raise CarlaError(
                f"expected the attribute {name} of {kind}, this server does not have it; take it out of render.camera_attributes"
                + (" or set render.exposure to automatic" if name.startswith("exposure") else "")
            )
        blueprint.set_attribute(name, value)
    return blueprint


def _upper_exposure(blueprint: Any) -> float:
    name = "exposure_max_bright"
    if not blueprint.has_attribute(name):
        raise CarlaError(
            f"expected the attribute {name} of {RGB}, this server does not have it; set render.exposure to automatic"
        )
    return float(blueprint.get_attribute(name).as_float())
