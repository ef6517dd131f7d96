"""Errors of a world in another process; each message says what to do. A drive that raises one has no result."""

from __future__ import annotations

from hardware.worlds.world import WorldError


class RemoteWorldError(WorldError):
    """Base of the faults of a world in another process. The process has been ended when one is raised."""


class WorldNotInstalled(RemoteWorldError):
    """The world's environment is not installed, or was installed from another lock file."""


class ServerLost(RemoteWorldError):
    """The process of the world ended: killed, crashed, or never started."""


class ServerTimeout(RemoteWorldError):
    """The process of the world did not answer in time: hung, stopped, or slow."""


class ServerVersionError(RemoteWorldError):
    """The process of the world uses another version of the protocol."""


class ServerProtocolError(RemoteWorldError):
    """The process of the world sent bytes that do not follow the protocol."""


class SimulatorError(RemoteWorldError):
    """The simulator raised an error."""


class WrongPictureError(RemoteWorldError):
    """A picture has a wrong size or type, or is of one colour."""


class WrongDepthError(RemoteWorldError):
    """Depth has a wrong size or type, or values that are not planar depth in metres."""


class WrongPoseError(RemoteWorldError):
    """A picture was taken from another pose, or the car is where no car can be."""
