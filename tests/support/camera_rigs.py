"""One rig for each camera driver: the driver, and the hands that expose frames, pull the cable and put it back."""

import queue
import time

import cv2
import numpy as np

from hardware.cameras.file import FileCamera
from hardware.cameras.interface import Frame
from hardware.cameras.oak import OakCamera, OakSource, OakStream, find_device
from hardware.cameras.socket import SocketCamera
from hardware.cameras.v4l2.driver import V4l2Camera
from hardware.cameras.v4l2.negotiation import Mode
from hardware.cameras.video import VideoCamera
from hardware.cameras.zed.driver import ZedCamera, ZedSource
from hardware.emulators.frame_server import FrameServer
from tests.support.v4l2_device import VideoDevice
from tests.support.v4l2_emulator import VideoPortEmulator
from tests.support.zed_emulator import ZedRegisters

PATH = "/dev/v4l/by-id/usb-Camera-video-index0"
SHAPE = (188, 336, 3)


class V4l2Rig:
    """A webcam; ``pixel_format`` YUYV or MJPG."""

    driven = True
    shape = SHAPE

    def __init__(self, tmp_path, pixel_format="YUYV"):
        self.format = pixel_format
        self.device = VideoDevice(formats={pixel_format: [(336, 188)]})
        self.port = VideoPortEmulator({PATH: self.device})
        self.camera = V4l2Camera(PATH, Mode(336, 188, 30.0, pixel_format), skip_frames=0, port=self.port)
        self.count = 0

    def produce(self):
        self.count += 1
        grey = np.full((188, 336, 2), 128, np.uint8)
        grey[:, :, 0] = 40 + self.count
        if self.format == "MJPG":
            data = cv2.imencode(".jpg", cv2.cvtColor(grey, cv2.COLOR_YUV2BGR_YUYV))[1].tobytes()
        else:
            data = grey.tobytes()
        self.device.expose(data)

    def unplug(self):
        self.device.unplug()

    def plug(self):
        self.device.plug()

    def missing(self, tmp_path):
        return V4l2Camera("/dev/v4l/by-id/none", Mode(336, 188, 30.0), port=self.port)

    def close(self):
        self.camera.close()
        assert self.port.open_files == 0


class MjpgRig(V4l2Rig):
    def __init__(self, tmp_path):
        super().__init__(tmp_path, "MJPG")


class ZedRig(V4l2Rig):
    """A ZED; its first frame after a start is thrown away."""

    def __init__(self, tmp_path):
        self.format = "YUYV"
        self.conf = tmp_path / "SN1.conf"
        self.conf.write_text(
            "[LEFT_CAM_VGA]\nfx=350\nfy=350\ncx=335\ncy=187\nk1=-0.17\nk2=0.02\n", encoding="utf-8"
        )
        self.device = VideoDevice(formats={"YUYV": [(1344, 376)]}, controls={}, extension=ZedRegisters())
        self.port = VideoPortEmulator({PATH: self.device})
        self.camera = ZedCamera(ZedSource(device=PATH, factory=self.conf, rate_hz=None), self.port)
        self.count = 0
        self.camera._stream._skip_frames = 0

    def produce(self):
        self.count += 1
        self.device.expose(bytes([40 + self.count, 128]) * (1344 * 376))

    def missing(self, tmp_path):
        return ZedCamera(ZedSource(device="/dev/v4l/by-id/none", factory=self.conf), self.port)


def host_stream(feed, pipelines, sent):
    """A builder of a pipeline on the host whose frames come out of a Python queue."""

    def build(dai, settings):
        class Feeder(dai.node.ThreadedHostNode):
            def __init__(self):
                dai.node.ThreadedHostNode.__init__(self)
                self.output = self.createOutput()

            def run(self):
                while self.isRunning():
                    try:
                        number, pixels = feed.get(timeout=0.02)
                    except queue.Empty:
                        continue
                    message = dai.ImgFrame()
                    message.setCvFrame(pixels, dai.ImgFrame.Type.BGR888i)
                    message.setSequenceNum(number)
                    message.setTimestamp(dai.Clock.now())
                    self.output.send(message)
                    sent.append(number)

        pipeline = dai.Pipeline(False)
        feeder = pipeline.create(Feeder)
        out = feeder.output.createOutputQueue(maxSize=1, blocking=False)
        pipelines.append(pipeline)
        return OakStream(pipeline, out)

    return build


class NothingPluggedIn:
    """depthai's list of devices; asking the real one takes half a second each time."""

    class Device:
        @staticmethod
        def getAllAvailableDevices():
            return []


class OakRig:
    """depthai's own queues and messages on the host; only the camera itself is replaced."""

    driven = True
    shape = SHAPE

    def __init__(self, tmp_path):
        self.feed, self.pipelines, self.sent, self.gone, self.count = queue.Queue(), [], [], False, 0
        build = host_stream(self.feed, self.pipelines, self.sent)

        def plugged(dai, settings):
            if self.gone:
                find_device(NothingPluggedIn, settings.device)
            return build(dai, settings)

        self.camera = OakCamera(OakSource(), plugged)

    def produce(self):
        self.feed.put((self.count, np.full(SHAPE, 40 + self.count, np.uint8)))
        deadline = time.monotonic() + 60.0
        while self.count not in self.sent:  # by depthai's own thread
            assert time.monotonic() < deadline
            time.sleep(0.001)
        self.count += 1

    def unplug(self):
        self.gone = True
        self.pipelines[-1].stop()
        self.pipelines[-1].wait()  # its thread must not take what is meant for the next one

    def plug(self):
        self.gone = False

    def missing(self, tmp_path):
        return OakCamera(OakSource(device="14442C10D13EABCE00"))

    def close(self):
        self.camera.close()


class SocketRig:
    driven = True
    shape = SHAPE

    def __init__(self, tmp_path):
        self.path = tmp_path / "frames"
        self.server = FrameServer(self.path)
        self.camera = SocketCamera(self.path)
        self.count = 0

    def produce(self):
        deadline = time.monotonic() + 60.0
        while self.server.clients == 0:
            assert time.monotonic() < deadline
            time.sleep(0.001)
        pixels = np.full(SHAPE, 40 + self.count, np.uint8)
        self.server.publish(Frame(pixels, time.time_ns(), time.monotonic_ns(), self.count))
        self.count += 1
        time.sleep(0.003)

    def unplug(self):
        self.server.close()

    def plug(self):
        self.server = FrameServer(self.path)

    def missing(self, tmp_path):
        return SocketCamera(tmp_path / "none")

    def close(self):
        self.camera.close()
        self.server.close()


class FolderRig:
    """Plays by its own clock."""

    driven = False
    shape = (24, 32, 3)
    rate_hz = 100.0

    def __init__(self, tmp_path):
        self.source = tmp_path / "pictures"
        self._write()
        self.camera = FileCamera(self.source, self.rate_hz)

    def _write(self):
        self.source.mkdir(exist_ok=True)
        for k in range(4):
            cv2.imwrite(str(self.source / f"{k}.png"), np.full(self.shape, 40 * k, np.uint8))

    def produce(self):
        """It needs no hand."""

    def unplug(self):
        for path in self.source.iterdir():
            path.unlink()

    def plug(self):
        self._write()

    def missing(self, tmp_path):
        return FileCamera(tmp_path / "none")

    def close(self):
        self.camera.close()


class VideoRig(FolderRig):
    def __init__(self, tmp_path):
        self.source = tmp_path / "video.avi"
        self._write()
        self.camera = VideoCamera(self.source, self.rate_hz, loop=False)

    def _write(self):
        video = cv2.VideoWriter(str(self.source), cv2.VideoWriter_fourcc(*"MJPG"), 30.0, self.shape[1::-1])
        for k in range(40):
            video.write(np.full(self.shape, 5 * k, np.uint8))
        video.release()

    def unplug(self):
        self.source.unlink()  # what is open plays to its end

    def missing(self, tmp_path):
        return VideoCamera(tmp_path / "none.mp4")


RIGS = {
    "v4l2": V4l2Rig, "v4l2-mjpg": MjpgRig, "zed": ZedRig, "oak": OakRig, "socket": SocketRig, "folder": FolderRig,
    "video": VideoRig,
}  # fmt: skip
