"""A driver behind a socket, in the egodriver protocol that users of alpasim and CARLA speak: serves until it is stopped.

    .venv/bin/python examples/my_driver.py 50051

Needs ``pip install 'advnerf[egodriver]'``. In an experiment: ``victims: {mine: {policy: grpc://127.0.0.1:50051}}``.
"""

import sys

from carla_driver_interface.driver import BaseDriver, DriveContext, DriveResult
from carla_driver_interface.geometry import Pose, Trajectory
from carla_driver_interface.server import run_server


class TowardsTheTape(BaseDriver):
    """Plans an arc to where the lower half of the picture is green; put your policy in its place."""

    name = "towards_the_tape"

    def drive(self, ctx: DriveContext) -> DriveResult:
        """Two seconds of plan in the car's frame: x forward, y left."""
        frame = ctx.session.latest_frame("camera_front")
        assert frame is not None, "a picture comes before each question"
        picture = frame.as_array().astype(float)
        lower = picture[len(picture) // 2 :]
        green = (lower[..., 1] - 0.6 * (lower[..., 0] + lower[..., 2])).clip(0.0).sum(axis=0)
        left, right = green[: len(green) // 2].sum(), green[len(green) // 2 :].sum()
        curvature_1pm = 0.9 * (left - right) / (left + right + 1.0)
        plan = Trajectory.empty()
        for number in range(1, 21):
            x_m = 0.08 * number
            ahead = Pose.from_xyz_yaw(x_m, 0.5 * curvature_1pm * x_m**2, 0.0, curvature_1pm * x_m)
            plan.append(ctx.time_now_us + number * 100_000, ahead)
        return DriveResult(trajectory_in_rig=plan)


if __name__ == "__main__":
    run_server(TowardsTheTape(), port=int(sys.argv[1]), host="127.0.0.1")
