"""Pictures for the page: small JPEG images, each with the capture stamp that names it."""

from __future__ import annotations

import json
import struct
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from advnerf_core.files import read_tensors
from advnerf_core.policies.contract import PolicyContractError
from advnerf_core.policies.declaration import ONNX_METADATA_KEY, declaration_beside
from advnerf_core.policies.view import PolicyView

CAMERA, ATTACKED, POLICY = 0, 1, 2
_HEAD = struct.Struct(">Bq")


@dataclass(frozen=True)
class Picture:
    """One picture.

    Attributes:
        channel: ``CAMERA``, ``ATTACKED`` or ``POLICY``.
        stamp_ns: Capture time of the image, which names it [ns].
        received_ns: When the node received the image, monotonic [ns].
    """

    channel: int
    stamp_ns: int
    received_ns: int
    jpeg: bytes

    def packed(self) -> bytes:
        """Bytes on the wire: channel, stamp in the order of the network, JPEG."""
        return _HEAD.pack(self.channel, self.stamp_ns) + self.jpeg


def jpeg_of(rgb: NDArray[np.uint8], width_px: int, quality: int) -> bytes:
    """Compress an image ``[H, W, 3]`` uint8 RGB, made smaller if it is wider than ``width_px``."""
    if rgb.shape[1] > width_px:
        height_px = max(1, round(rgb.shape[0] * width_px / rgb.shape[1]))
        rgb = np.asarray(cv2.resize(rgb, (width_px, height_px), interpolation=cv2.INTER_AREA), np.uint8)
    done, data = cv2.imencode(
        ".jpg", cv2.cvtColor(rgb, cv2.COLOR_RGB2BGR), [cv2.IMWRITE_JPEG_QUALITY, quality]
    )
    assert done  # only an empty image cannot be compressed, and an image message has pixels
    return data.tobytes()


def view_of_policy(policy: str) -> PolicyView | None:
    """Read the view of a policy from its ``.safetensors`` or ``.onnx`` file, without torch; None for any other policy."""
    path = Path(policy)
    if not path.is_file():
        return None
    try:
        if path.suffix == ".onnx":
            return _view_of_onnx(path)
        if path.suffix == ".safetensors":
            return PolicyView.from_dict(json.loads(read_tensors(path, "numpy", ())[0]["view"]))
    except (PolicyContractError, OSError, KeyError, ValueError):
        pass
    return None


def _view_of_onnx(path: Path) -> PolicyView | None:
    """The view in the declaration of an ONNX file; None where ONNX Runtime is missing or cannot read the file."""
    try:
        import onnxruntime

        session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    except Exception:  # its exceptions have no common base
        return None
    embedded = session.get_modelmeta().custom_metadata_map.get(ONNX_METADATA_KEY)
    return declaration_beside(path, embedded).view
