"""What can go wrong with a world in another process, each with what to do about it. None of these ends as a result."""

from __future__ import annotations

from hardware.worlds.world import WorldError


class RemoteWorldError(WorldError):
    """Base of the faults of a world in another process. The process has been ended when one is raised."""


class WorldNotInstalled(RemoteWorldError):
    """The world's own environment is not there, or was made from another lock file."""


class ServerLost(RemoteWorldError):
    """The process of the world ended: killed, crashed, or never started."""


class ServerTimeout(RemoteWorldError):
    """The process of the world did not answer in time: hung, stopped, or slow."""


class ServerVersionError(RemoteWorldError):
    """The process of the world speaks another version of the protocol."""


class ServerProtocolError(RemoteWorldError):
    """The process of the world sent bytes that do not follow the protocol."""


class SimulatorError(RemoteWorldError):
    """The simulator raised an error of its own."""


class WrongPictureError(RemoteWorldError):
    """A picture is not what a camera of the world gives: its size, its type, or a picture of one colour."""


class WrongDepthError(RemoteWorldError):
    """Depth is not what a camera of the world gives: its size, its type, or values that are no planar depth in metres."""


class WrongPoseError(RemoteWorldError):
    """A picture was taken from elsewhere, or the car is where no car can be."""
