"""The registers of a ZED behind its UVC extension unit, for `tests.support.v4l2_emulator.VideoDevice.extension`."""

from __future__ import annotations

import errno
import os
import struct

_SET_CUR, _GET_CUR, _GET_LEN = 0x01, 0x81, 0x85


class ZedRegisters:
    """Answers control messages byte by byte.

    Args:
        length: Bytes of a message: 384 on USB 3, 64 on USB 2.

    Attributes:
        processor: Registers of the image processor by address; the automatic is on at first.
        sensors: Registers of the left and the right sensor by address.
        stuck: Addresses that accept new values but keep their own.
        messages: Every message that was written.
    """

    def __init__(self, length: int = 384) -> None:
        self.length = length
        self.processor = {0x80181033: 0xB3, 0x80181833: 0xB3}
        self.sensors: tuple[dict[int, int], dict[int, int]] = ({0x3508: 0x01, 0x3509: 0x80}, {})
        self.stuck: set[int] = set()
        self.messages: list[bytes] = []
        self._answer = 0

    def __call__(self, unit: int, selector: int, query: int, data: bytearray) -> None:
        """Answer one query in place."""
        if (unit, selector) != (4, 2):
            raise OSError(errno.ENOENT, os.strerror(errno.ENOENT))
        if query == _GET_LEN:
            struct.pack_into("<H", data, 0, self.length)
        elif len(data) != self.length:
            raise OSError(errno.ENOBUFS, os.strerror(errno.ENOBUFS))
        elif query == _SET_CUR:
            self.messages.append(bytes(data))
            self._take(data)
        elif query == _GET_CUR:
            data[17] = self._answer
        else:
            raise OSError(errno.EBADRQC, os.strerror(errno.EBADRQC))

    def _take(self, data: bytearray) -> None:
        (address,) = struct.unpack_from(">I", data, 5)
        registers = {0xA2: self.processor, 0xA3: self.sensors[0], 0xA5: self.sensors[1]}[data[1]]
        # A message with the wrong width, device or page is ignored.
        sensor = data[1] != 0xA2
        if (data[2], data[3], data[9]) != ((0x6C, 2, 0x90) if sensor else (0, 4, 0)) or (
            data[10],
            data[12],
        ) != (1, 1):
            return
        if data[0] == 0x50 and address not in self.stuck:
            registers[address] = data[16]
        elif data[0] == 0x51:
            self._answer = registers.get(address, 0)
