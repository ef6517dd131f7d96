"""Schema of launch files."""

from __future__ import annotations

from typing import Any

from pydantic import ConfigDict, Field, field_validator

from advnerf_core.strict import StrictModel


class _Strict(StrictModel):
    model_config = ConfigDict(populate_by_name=True)


class Respawn(_Strict):
    """Restart rule of a node that is not required.

    Attributes:
        max_restarts: Restarts within the window after which the node is not restarted again.
        window_s: Length of the window [s].
        delay_s: Wait before the first restart, doubled for each further one in the window [s].
        max_delay_s: Longest wait [s].
    """

    max_restarts: int = Field(default=5, ge=1)
    window_s: float = Field(default=60.0, gt=0)
    delay_s: float = Field(default=0.2, ge=0)
    max_delay_s: float = Field(default=5.0, ge=0)


class NodeEntry(_Strict):
    """A node of a launch file.

    Attributes:
        module: Python module to run, for example ``nodes.camera``.
        config: Configuration of the node.
        enabled: Key ``if``. False disables the node.
        required: Whether the end of the node stops the whole launch.
        respawn: Restart rule of a node that is not required. None means no restart.
        ends_launch: Whether the regular end of the node, such as a player at the end of its bag, ends the launch with exit code 0.
        stop_last: Stop the node after the others have ended (a recorder, a simulated lab).
        host: Host that runs the node, if the file has hosts.
        env: Environment variables to add.
        start_timeout_s: Time until its first status [s].
        hang_timeout_s: Time without a status after which the node counts as hung and is killed [s].
    """

    module: str
    config: dict[str, Any] = Field(default_factory=dict)
    enabled: bool = Field(default=True, alias="if")
    required: bool = True
    respawn: Respawn | None = None
    ends_launch: bool = False
    stop_last: bool = False
    host: str | None = None
    env: dict[str, str] = Field(default_factory=dict)
    start_timeout_s: float = Field(default=60.0, gt=0)
    hang_timeout_s: float = Field(default=5.0, gt=0)

    @field_validator("config", mode="before")
    @classmethod
    def _no_config_is_an_empty_one(cls, value: Any) -> Any:
        return {} if value is None else value


class RecordEntry(_Strict):
    """Settings of the recorder that the launch adds.

    Attributes:
        output: Bag folder, relative to the run folder.
        topics: Topics to record; none records all topics of the topic table.
        attachments: Files to attach to the bag besides the resolved launch file, such as calibration and attack files. An empty
            entry (a parameter without a value) is ignored.
        host: Host that records; none selects the host without an address, whose disk is larger.
        max_bag_duration_s: Start a new file after this time [s]; none uses the recorder's default.
        max_bag_size_mb: Start a new file at this size [MiB]; none uses the recorder's default.
    """

    output: str = "bag"
    topics: list[str] | None = None
    attachments: list[str | None] = Field(default_factory=list)
    host: str | None = None
    max_bag_duration_s: float | None = Field(default=None, gt=0)
    max_bag_size_mb: float | None = Field(default=None, gt=0)


class HostEntry(StrictModel):
    """A host of a launch file.

    Attributes:
        address: Address of this host. Exactly one host has an address, and listens there.
        watch_port: TCP port on which the listening host sends.
        drive_port: TCP port on which the listening host receives.
        key: Name of the host's key; none uses the name of the host.
    """

    address: str | None = None
    watch_port: int = Field(default=5570, ge=1024, le=65535)
    drive_port: int = Field(default=5571, ge=1024, le=65535)
    key: str | None = None


class LaunchFile(_Strict):
    """Content of a launch file.

    Attributes:
        name: Name of the launch.
        params: Values that the file and other parameters can use as ``${name}``. Three are predefined: ``${run_dir}``,
            ``${socket_dir}``, a folder whose path is short enough for Unix sockets, and ``${twin_calibration}``, the folder with the
            calibration files of the simulated lab.
        nodes: The nodes, in the order of their start.
        record: Settings of an added recorder; true uses the defaults.
        include: Launch files, relative to this one, that this one extends.
        hosts: The two computers of the launch; none runs all nodes on one.
        operator: Host from which the operator arms and sends requests; none selects the host without an address.
        keys: Key folder of each host. It may be omitted only on a loopback address; then the other host can only watch.
    """

    name: str
    params: dict[str, Any] = Field(default_factory=dict)
    nodes: dict[str, NodeEntry]
    record: bool | RecordEntry = False
    include: list[str] = Field(default_factory=list)
    hosts: dict[str, HostEntry] = Field(default_factory=dict)
    operator: str | None = None
    keys: str | None = None
