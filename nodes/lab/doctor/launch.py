"""The checks for one launch file: the devices, files, ports and libraries that it needs."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel

from advnerf_core.errors import AdvnerfError
from advnerf_core.policies.load import is_factory
from advnerf_core.strict import validate
from calibration.schema import CameraCalibration, load_calibration
from hardware.mocap.vicon import ViconConfig
from hardware.motor.vesc_settings import TimeoutSettings
from nodes.camera import CameraNodeConfig
from nodes.gateway import GatewayConfig
from nodes.lab.doctor import cameras, files, graphics, machine, mocap, motor, network, ros2
from nodes.lab.doctor.check import CHILD_S, FAILURE, OK, CheckResult, DoctorCheck, in_child, report
from nodes.lab.doctor.recording import ImageFormat, bytes_per_s
from nodes.launching.launch_check import check_nodes
from nodes.launching.launch_file import Plan
from nodes.launching.launch_hosts import GATEWAY
from nodes.monitor import MonitorConfig, MonitorOutputConfig
from nodes.motor import MotorConfig
from nodes.policy import PolicyNodeConfig
from nodes.recorder import RecorderConfig
from nodes.ros2 import Ros2Config
from nodes.safety import SafetyConfig
from nodes.vicon import ViconNodeConfig
from nodes.viewer import ViewerConfig

_CHILD_DEADLINE_S = CHILD_S + 5.0
_NODES_S = 90.0
_TWIN, _POLICY = "nodes.twin", "nodes.policy"
# Devices that a node of the launch creates do not exist before it runs.
_OF_THE_RUN = ("<run_dir>", "<socket_dir>")
_POLICY_SLOW_MS = 60.0
M = TypeVar("M", bound=BaseModel)


@dataclass(frozen=True)
class _Asked:
    """A launch file and one of its nodes."""

    plan: Plan
    name: str

    @property
    def on_twin(self) -> bool:
        return any(entry.module == _TWIN for entry in self.plan.nodes.values())

    def config(self, kind: type[M]) -> M:
        return validate(kind, self.plan.documents[self.name])


def checks_of(plan: Plan, folder: Path) -> list[DoctorCheck]:
    """Return the checks for a launch file on this host."""
    checks = [
        DoctorCheck("versions", machine.versions),
        DoctorCheck("machine", machine.machine),
        DoctorCheck("places", machine.places),
        DoctorCheck("sockets", machine.sockets),
        DoctorCheck("launches", machine.launches),
        DoctorCheck("nodes", partial(_nodes, plan), _NODES_S),
        DoctorCheck("calibration", partial(files.calibrations, plan)),
        DoctorCheck("files", partial(files.named, plan)),
    ]
    for name, entry in plan.nodes.items():
        asked = _Asked(plan, name)
        if (make := _BY_MODULE.get(entry.module)) is not None:
            try:
                checks += make(asked)
            except (AdvnerfError, OSError):
                continue  # the check "nodes" reports errors of the node's configuration
    if "recorder" in plan.documents:
        checks.append(DoctorCheck("disk", partial(_disk, plan, folder)))
    return checks


def policy_problems(plan: Plan) -> list[str]:
    """Return the errors of the policies of a launch file: a missing file, an image size other than the camera's, a wrong goal.

    Each policy is loaded in a separate process. Nodes and devices are not used.
    """
    problems = missing_policies(plan)
    for name, asked in _policies(plan):
        if _missing_policy(asked.config(PolicyNodeConfig)) is None:
            _, unfit = _try_policy(asked.config(PolicyNodeConfig), _image_size(plan))
            problems += [f"{name}: {finding.found}; {finding.do}" for finding in unfit]
    return problems


def missing_policies(plan: Plan) -> list[str]:
    """Return an error for each policy file that is not there; no policy is loaded."""
    return [
        f"{name}: expected a policy file at {missing}, found none; give another with --set params.policy=FILE"
        for name, asked in _policies(plan)
        if (missing := _missing_policy(asked.config(PolicyNodeConfig))) is not None
    ]


def _policies(plan: Plan) -> list[tuple[str, _Asked]]:
    return [(name, _Asked(plan, name)) for name, entry in plan.nodes.items() if entry.module == _POLICY]


def _missing_policy(config: PolicyNodeConfig) -> str | None:
    return None if is_factory(config.policy) or Path(config.policy).exists() else str(config.policy)


def _nodes(plan: Plan) -> list[CheckResult]:
    """Check whether every node accepts its configuration, by asking the nodes."""
    problems = check_nodes(plan)
    if problems:
        return [
            CheckResult("nodes", FAILURE, " ".join(text.split()), "correct the launch file")
            for text in problems.values()
        ]
    return report("nodes", OK, f"{', '.join(plan.nodes)} accept their configuration")


def _camera(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(CameraNodeConfig)
    where = str(getattr(config.source, "path", ""))
    if config.source.kind == "socket" and where.startswith(_OF_THE_RUN):
        return [] if asked.on_twin else [DoctorCheck("camera", partial(_nobody, "camera", where))]
    checks: list[DoctorCheck] = []
    if config.source.kind == "oak":
        checks.append(
            DoctorCheck("OAK", partial(cameras.oaks, True), 30.0, "unplug the OAK and plug it in again")
        )
    calibration = _calibration(config.calibration)
    checks.append(
        DoctorCheck(
            "camera",
            partial(cameras.source, config.source, calibration),
            20.0,
            "unplug the camera and plug it in again",
        )
    )
    return checks


def _calibration(file: Path) -> CameraCalibration | None:
    try:
        return load_calibration(CameraCalibration, file)
    except AdvnerfError:
        return None  # reported under "calibration"


def _nobody(name: str, where: str) -> list[CheckResult]:
    do = "give the real device, or enable the simulated lab (twin.if=true)"
    return report(name, FAILURE, f"expected at {where}, but this launch has no node that provides it", do)


def _vicon(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(ViconNodeConfig)
    if config.library is not None:
        return [DoctorCheck("VICON", partial(network.mocap_library, config.library, config.hostname))]
    if asked.on_twin:
        return [DoctorCheck("VICON", partial(mocap.free_port, config.port, config.host))]
    listening = ViconConfig(config.subjects, config.host, config.port, source=config.source)
    # Boards and wands may be absent, but without the car nothing can be armed.
    return [DoctorCheck("VICON", partial(mocap.listen, listening, True, mocap.LISTEN_S, ("car",)))]


def _motor(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(MotorConfig)
    if config.port.startswith(_OF_THE_RUN):
        return [] if asked.on_twin else [DoctorCheck("VESC", partial(_nobody, "VESC", config.port))]
    wanted = TimeoutSettings(config.controller_timeout_ms, config.controller_brake_current_a)
    return [
        DoctorCheck("serial", motor.serial_ports),
        DoctorCheck("VESC", partial(motor.vesc, config.port, wanted, config.battery_warning_v, True)),
    ]


def _safety(asked: _Asked) -> list[DoctorCheck]:
    return (
        [DoctorCheck("gamepad", partial(motor.gamepads, True))]
        if asked.config(SafetyConfig).teleop == "hold"
        else []
    )


def _policy(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(PolicyNodeConfig)
    if _missing_policy(config) is not None:
        return []  # reported under "files"
    return [
        DoctorCheck("policy", partial(_policy_findings, config, _image_size(asked.plan)), _CHILD_DEADLINE_S)
    ]


def _image_size(plan: Plan) -> tuple[int, int] | None:
    """Width and height of the launch's camera [px], from the first calibration that a node names."""
    for entry in plan.documents.values():
        for key in ("calibration", "camera"):
            file = entry.data.get(key)
            if isinstance(file, str) and file.endswith(".yaml") and (found := _calibration(Path(file))):
                return found.width, found.height
    return None


def _policy_findings(config: PolicyNodeConfig, size: tuple[int, int] | None) -> list[CheckResult]:
    data, rows = _try_policy(config, size)
    if data is None:
        return rows
    if data["ms"] > _POLICY_SLOW_MS:
        do = "use a faster computer, or an ONNX policy"
        rows += report("policy", FAILURE, f"{data['ms']:.0f} ms for one image", do)
    return [
        CheckResult(
            "policy", OK, f"{config.policy}, {data['sha256'][:12]}, {data['ms']:.1f} ms for one image"
        ),
        *rows,
    ]


def _try_policy(
    config: PolicyNodeConfig, size: tuple[int, int] | None
) -> tuple[dict[str, Any] | None, list[CheckResult]]:
    """Load a policy in a separate process.

    Args:
        size: Width and height of the camera's images [px], if known.

    Returns:
        The policy's declaration (None if it cannot be loaded), and a finding for each mismatch.
    """
    answer = in_child("policy", config.policy, config.sha256)
    if answer.data is None:
        trouble = answer.trouble.partition(": ")[2] or answer.trouble
        return None, report("policy", FAILURE, trouble, answer.cure("correct params.policy"))
    data, rows = answer.data, []
    if size is not None and tuple(data["size"]) != size:
        text = f"trained for {data['size'][0]} x {data['size'][1]}, the camera is calibrated for {size[0]} x {size[1]}"
        rows += report("policy", FAILURE, text, "train for this camera, or set the size of the source")
    if data["goal_size"] != len(config.goal):
        text = f"expected a goal of {data['goal_size']} numbers, got {len(config.goal)}"
        rows += report("policy", FAILURE, text, "set policy.goal")
    return data, rows


def _twin(asked: _Asked) -> list[DoctorCheck]:
    return [DoctorCheck("EGL", partial(graphics.egl, True), _CHILD_DEADLINE_S)]


def _attack(asked: _Asked) -> list[DoctorCheck]:
    return [DoctorCheck("torch", partial(graphics.torch, True), _CHILD_DEADLINE_S)]


def _monitor(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(MonitorConfig)
    if not isinstance(config.display, MonitorOutputConfig):
        return (
            []
            if asked.on_twin
            else [DoctorCheck("screens", partial(_nobody, "screens", str(config.display.path)))]
        )
    return [DoctorCheck("screens", partial(graphics.screens, config.display), _CHILD_DEADLINE_S)]


def _gateway(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(GatewayConfig)
    return [DoctorCheck("clock", machine.clock), DoctorCheck("network", partial(network.gateway, config))]


def _ros2(asked: _Asked) -> list[DoctorCheck]:
    return [DoctorCheck("ROS 2", partial(ros2.node, asked.config(Ros2Config)))]


def _viewer(asked: _Asked) -> list[DoctorCheck]:
    config = asked.config(ViewerConfig)
    return [DoctorCheck("viewer", partial(network.viewer, config.host, config.port))]


def _disk(plan: Plan, folder: Path) -> Sequence[CheckResult]:
    config = validate(RecorderConfig, plan.documents["recorder"])
    # With two hosts, all recorded topics are sent to this host.
    roles = None
    if GATEWAY not in plan.nodes:
        roles = {
            role for name, entry in plan.nodes.items() for role in (name, entry.module.rsplit(".", 1)[-1])
        }
    return machine.disk(folder, bytes_per_s(pictures_of(plan), config.topics, roles, len(config.statuses_of)))


def pictures_of(plan: Plan) -> ImageFormat:
    """Size and rate of the images of a launch file; defaults if its camera is on another host."""
    for name, entry in plan.nodes.items():
        if entry.module == "nodes.camera":
            try:
                config = validate(CameraNodeConfig, plan.documents[name])
                size = load_calibration(CameraCalibration, config.calibration)
            except AdvnerfError:
                break
            rate_hz = 1.0 / config.source.period_s() if config.source.period_s() else ImageFormat.rate_hz
            return ImageFormat(size.width, size.height, rate_hz, config.compressed is not None)
    return ImageFormat()


_BY_MODULE: dict[str, Callable[[_Asked], list[DoctorCheck]]] = {
    "nodes.camera": _camera, "nodes.vicon": _vicon, "nodes.motor": _motor, "nodes.safety": _safety, "nodes.policy": _policy,
    "nodes.twin": _twin, "nodes.attack": _attack, "nodes.monitor": _monitor, "nodes.gateway": _gateway, "nodes.viewer": _viewer,
    "nodes.ros2": _ros2,
}  # fmt: skip
