"""Helpers of the page's tests: a run with a real page and a real safety process, and browsers that speak the page's protocol."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import ssl
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import yaml
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from nodes.runtime.bus import Bus
from nodes.runtime.messages import drive_message, image_message, pose_message

REPOSITORY = Path(__file__).parents[2]
TWIN = REPOSITORY / "calibration" / "twin"
STOP_S = 0.35


class Car(threading.Thread):
    """A car that is measured, seen and commanded, as far as page and safety node can tell; and the test's eyes on the bus."""

    def __init__(self, folder):
        super().__init__(daemon=True)
        self.folder, self.stopping = folder, False
        self.newest, self.acts, self.moves, self.heard = {}, [], [], {}
        self.pictures = True

    def run(self):
        heard = (
            "/safety/state",
            "/safety/drive",
            "/operator/act",
            "/attack/file",
            "/attack/switch",
            "/status/page",
        )
        with Bus(self.folder) as bus:
            for topic in heard:
                bus.subscribe(topic, queue=1000)
            next_s, tick = time.monotonic(), 0
            while not self.stopping:
                bus.wait(max(0.0, next_s - time.monotonic()))
                for received in bus.receive():
                    self._hear(received)
                if time.monotonic() < next_s:
                    continue
                next_s, tick = next_s + 0.02, tick + 1
                self._say(bus, tick)

    def _hear(self, received):
        message = received.message()
        self.newest[received.topic] = message
        self.heard.setdefault(received.topic, []).append((received.info.publish_mono_ns, message))
        if received.topic == "/operator/act":
            self.acts.append(message)
        elif received.topic == "/safety/drive":
            self.moves.append((received.info.publish_mono_ns, float(message.drive.speed)))

    def _say(self, bus, tick):
        now_ns = time.time_ns()
        bus.publish("/vicon/car", pose_message(np.eye(4), now_ns))
        bus.publish("/policy/drive", drive_message(0.5, 0.0, now_ns))
        if tick % 5 == 0 and self.pictures:
            rgb = np.full((188, 336, 3), tick % 255, np.uint8)
            for topic in ("/camera/image_raw", "/compositor/image"):
                bus.publish(topic, image_message(rgb, now_ns, "camera"))

    @property
    def armed(self):
        return bool(getattr(self.newest.get("/safety/state"), "armed", False))

    @property
    def reason(self):
        return getattr(self.newest.get("/safety/state"), "reason", "")

    def stop_after(self, since_ns):
        """Seconds from an instant to the first stop after the last command to move."""
        moving = [t for t, speed in list(self.moves) if speed > 0.0]
        stops = [t for t, speed in list(self.moves) if speed == 0.0 and t > (moving[-1] if moving else 0)]
        assert stops, "the car was not stopped"
        return (stops[0] - since_ns) / 1e9


class Run:
    """A run folder with page, safety node and car."""

    def __init__(self, folder, teleop="hold", **config):
        self.folder, self.processes = folder, {}
        self.car = Car(folder)
        safety = {
            "room": str(TWIN / "room.yaml"),
            "vehicle": str(TWIN / "vehicle.yaml"),
            "nodes": [],
            "teleop": teleop,
        }
        page = {"port": 0, "room": str(TWIN / "room.yaml"), **config}
        self.configs = {"safety": safety, "page": page}
        nodes = {name: {"module": f"nodes.{name}", "config": config} for name, config in self.configs.items()}
        (folder / "launch.resolved.yaml").write_text(yaml.safe_dump({"name": "test", "nodes": nodes}))

    def start(self, *names, environment=None):
        for name in names or self.configs:
            file = self.folder / f"{name}.yaml"
            file.write_text(yaml.safe_dump(self.configs[name]))
            command = [sys.executable, "-m", f"nodes.{name}", "--config", str(file)]
            log = open(self.folder / f"{name}.log", "ab")  # noqa: SIM115 - belongs to the child
            self.processes[name] = subprocess.Popen(
                [*command, "--run-dir", str(self.folder), "--name", name],
                stdout=log,
                stderr=log,
                cwd=REPOSITORY,
                env={**os.environ, **(environment or {})},
            )
        if not self.car.is_alive():
            self.car.start()
        self.wait(lambda: (self.folder / "page" / "door.json").exists(), "the page")
        if "safety" in self.processes:
            self.wait(lambda: "/safety/state" in self.car.newest, "the safety node")
        return self

    @property
    def door(self):
        return json.loads((self.folder / "page" / "door.json").read_text())

    @property
    def port(self):
        return int(self.door["url"].rstrip("/").rpartition(":")[2])

    def log(self):
        """What the page wrote about acts."""
        return [json.loads(line) for line in (self.folder / "page" / "acts.jsonl").read_text().splitlines()]

    def counter(self, name):
        status = self.car.newest["/status/page"]
        return dict(zip(status.counter_names, status.counter_values, strict=True))[name]

    def wait(self, condition, what, timeout_s=20.0):
        deadline = time.monotonic() + timeout_s
        while not condition():
            for name, process in self.processes.items():
                assert process.poll() is None, (
                    f"{name} ended: {(self.folder / f'{name}.log').read_text()[-2000:]}"
                )
            assert time.monotonic() < deadline, f"gave up waiting for {what}; the car is {self.car.reason!r}"
            time.sleep(0.01)

    def close(self):
        self.car.stopping = True
        for process in self.processes.values():
            with contextlib.suppress(ProcessLookupError):
                process.send_signal(signal.SIGCONT)
                process.terminate()
        for process in self.processes.values():
            process.wait(15.0)
        if self.car.is_alive():
            self.car.join()


def request(port, path="/", headers=None, method="GET", body=None, tls=None, source=None):
    """One HTTP request: status, headers, body. The certificate of a ``tls`` connection is not checked here."""
    if tls:
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
        context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        connection = http.client.HTTPSConnection(
            "127.0.0.1", port, timeout=10, context=context, source_address=source
        )
    else:
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=10, source_address=source)
    try:
        connection.request(method, path, body, headers or {})
        response = connection.getresponse()
        return response.status, response.headers, response.read()
    finally:
        connection.close()


def cookie_of(port):
    """The session that a browser of this user gets."""
    _, headers, _ = request(port)
    return headers["set-cookie"].partition(";")[0]


class Browser:
    """A browser, as far as the node can tell: answers beats while it holds, and draws every picture."""

    def __init__(self, port, cookie=None, origin=None, tls=None, answers=True):
        scheme = "https" if tls else "http"
        context = None
        if tls:
            context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
            context.check_hostname, context.verify_mode = False, ssl.CERT_NONE
        headers = {"Cookie": cookie_of(port) if cookie is None else cookie}
        self._stack = contextlib.ExitStack()
        opening = connect(
            f"{'wss' if tls else 'ws'}://127.0.0.1:{port}/live",
            origin=f"{scheme}://127.0.0.1:{port}" if origin is None else origin,
            additional_headers=headers,
            ssl=context,
            compression=None,
            max_size=2**22,
        )
        self.socket = self._stack.enter_context(opening)
        self.welcome, self.state, self.answers, self.pictures, self.beats = None, None, [], [], []
        self.press, self.held, self.responsive = 0, False, answers
        self.frame, self.closed, self._n, self._lock = "0", False, 0, threading.Lock()
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()
        self.wait(lambda: self.welcome is not None and self.state is not None, "the welcome")
        self.tell({"t": "wants", "c": [0, 1]})

    def _listen(self):
        try:
            for data in self.socket:
                if isinstance(data, bytes):
                    self._draw(data)
                else:
                    self._hear(json.loads(data))
        except ConnectionClosed:
            pass
        self.closed = True

    def _draw(self, data):
        stamp = str(int.from_bytes(data[1:9], "big"))
        self.pictures.append((data[0], stamp, data[9:]))
        self.frame = stamp
        if self.responsive:
            self.tell({"t": "seen", "c": data[0], "s": stamp})

    def _hear(self, message):
        kind = message["t"]
        if kind == "welcome":
            self.welcome = message
        elif kind == "state":
            self.state = message
        elif kind == "beat":
            self.beats.append(message["beat"])
            if self.held and self.responsive:
                self.act("hold", beat=message["beat"], press=self.press)
        else:
            self.answers.append(message)

    def tell(self, message):
        with contextlib.suppress(ConnectionClosed):
            self.socket.send(json.dumps(message))

    def act(self, kind, **more):
        with self._lock:
            self._n += 1
            self.tell({"t": kind, "key": self.welcome["key"], "n": self._n, "frame": self.frame, **more})
            return self._n

    def do(self, kind, **more):
        """An act and why it was refused; empty if it was done."""
        number = self.act(kind, **more)
        found = lambda: [a for a in self.answers if a.get("n") == number]  # noqa: E731
        self.wait(found, f"an answer to {kind}")
        return found()[0]["refused"]

    def take(self, name="Ann"):
        self.wait(lambda: self.frame != "0", "a picture")
        return self.do("take", name=name)

    def hold(self):
        self.press, self.held = self.press + 1, True

    def release(self):
        self.held = False
        return self.do("release", press=self.press)

    def wait(self, condition, what, timeout_s=10.0):
        deadline = time.monotonic() + timeout_s
        while not condition():
            assert time.monotonic() < deadline, f"gave up waiting for {what}; {self.answers[-3:]}"
            time.sleep(0.005)

    def close(self):
        self._stack.close()
        self._thread.join()
