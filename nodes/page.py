"""The page node: shows the running launch in a browser, and passes on what its operator asks for.

One operator at a time has the desk; all others watch. The car may move only while the operator holds a button on the page: the
node then reports the button like the teleop node (``safety.teleop: hold``), and the safety node decides. The page is served to this
computer only, unless ``host`` says otherwise; then it needs TLS and a one-time code. The page is no safety-rated stop.
"""

from __future__ import annotations

import contextlib
import json
import sys
from pathlib import Path
from typing import Any

import cv2

from advnerf_core.files import write_atomically
from advnerf_core.policies.view import PolicyView
from calibration.schema import RoomCalibration, load_calibration
from nodes.launching.launched import read_launched
from nodes.operator_page import board as topics
from nodes.operator_page.board import ViewState
from nodes.operator_page.catalogue import read_catalogue
from nodes.operator_page.client import ClientAct, Gone
from nodes.operator_page.config import PageConfig
from nodes.operator_page.desk import Desk
from nodes.operator_page.diary import Diary
from nodes.operator_page.disk import DiskWriter
from nodes.operator_page.operation import ACT, FILE, RESET, SWITCH, TELEOP, Operation
from nodes.operator_page.pictures import ATTACKED, CAMERA, POLICY, Picture, jpeg_of, view_of_policy
from nodes.operator_page.recording import LAUNCH_RECORDER, RECORDER, RecorderControl
from nodes.operator_page.server import PageServer
from nodes.operator_page.trial import Trial
from nodes.runtime.arm_requests import ARM
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import stamp_ns
from nodes.runtime.node import ACTIVE, READY, Inbox, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.pictures import rgb_image
from nodes.runtime.process import run_node_main
from nodes.runtime.topics import status_topic

_TICK_HZ = 50.0
_BEAT_NS, _STATE_NS, _DOOR_NS = NS_PER_S // 20, NS_PER_S // 10, NS_PER_S
_COMPOSITOR = "/compositor/image"
_INBOX = 4096
_OFF_TRACK_M = 0.4
FOLDER, DOOR, LOG = "page", "page/door.json", "page/acts.jsonl"


class PageNode(Node):
    """Connects the bus, the desk and the web server."""

    opens = "a web server"
    tick_rate_hz = _TICK_HZ

    def __init__(self, config: PageConfig, run_dir: Path) -> None:
        self._config, self._run_dir = config, run_dir
        launched = read_launched(run_dir)
        room = None if config.room is None else load_calibration(RoomCalibration, config.room)
        nodes = launched.nodes if config.nodes is None else config.nodes
        self._catalogue, self._left_out = read_catalogue(config.attacks)
        for line in self._left_out:  # the status has room for one
            print(f"page: {line}", file=sys.stderr, flush=True)
        self._board = ViewState(room, nodes)
        self._view: PolicyView | None = view_of_policy(config.policy)
        self._operates = config.role == "operate"
        self._stops = self._operates or launched.known
        self._holds = launched.holds
        self._desk = Desk(config)
        self._disk = DiskWriter()
        self._diary = Diary(run_dir / LOG, self._disk)
        self._recording = RecorderControl(run_dir, nodes, self._operates)
        path = None if room is None else room.reference_path
        off_track_m = _OFF_TRACK_M if room is None else room.off_track_m
        self._operation = Operation(
            self._desk,
            self._board,
            self._diary,
            Trial(path, off_track_m, config.trial_ticks),
            self._recording,
            self._catalogue,
            launched,
            None if room is None else room.start_pose,
            self._operates,
            lambda client, answer: self._server.answer(client, answer),
        )
        self.inbox: Inbox[ClientAct | Gone] = Inbox(_INBOX)
        recorders = [name for name in (RECORDER, LAUNCH_RECORDER) if self._operates and name not in nodes]
        statuses = tuple(map(status_topic, (*nodes, *recorders)))
        self.subscriptions = (config.camera_topic, _COMPOSITOR, *topics.TOPICS, *statuses)
        self.publications = self._publications(launched.twin)
        self._beat_ns = self._state_ns = self._door_ns = 0
        self._door_is_new = True
        self._pictures = self._trouble_count = 0
        self._server = PageServer(config, self.inbox, self._png_of, self._welcome, self._operation.stops)
        self._server.start()

    @classmethod
    def build(cls, config: PageConfig, context: NodeContext) -> PageNode:
        """Build the node and start the server."""
        cv2.setNumThreads(1)
        return cls(config, context.run_dir)

    @property
    def url(self) -> str:
        """Address of the page."""
        return self._server.url

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Show a message."""
        if topic in (self._config.camera_topic, _COMPOSITOR):
            self._show(topic, message, info, now)
            return []
        self._board.hear(topic, message, info)
        if topic == status_topic(RECORDER):
            self._recording.heard(message)
        if topic == topics.SAFETY:
            self._operation.heard_safety(message, info)
        elif topic in topics.LABELS:
            self._operation.heard_label()
        elif topic == topics.SENT:
            self._operation.heard_motor(message, info)
        # A trial is measured by every pose, as in a bag, and not only by those at the page's own ticks.
        return self._operation.follow(now) if self._operates and topic in (topics.SAFETY, topics.CAR) else []

    def receive(self, item: ClientAct | Gone, now: Now) -> list[Out]:
        """Decide an act of a browser, or note that it has gone."""
        if isinstance(item, Gone):
            return self._operation.gone(item.client, now)
        return self._operation.obey(item, now)

    def tick(self, now: Now) -> list[Out]:
        """Check the button, send a beat to the operator and the state to all, and keep the one-time code fresh."""
        outs = self._operation.tick(now)
        if now.mono_ns - self._beat_ns >= _BEAT_NS and self._desk.lease is not None:
            self._beat_ns = now.mono_ns
            self._server.send_beat(self._desk.lease.client, self._desk.beat(now.mono_ns))
        if now.mono_ns - self._state_ns >= _STATE_NS:
            self._state_ns = now.mono_ns
            if self._server.viewers:
                self._server.send_state(json.dumps(self._state(now), separators=(",", ":")))
        if now.mono_ns - self._door_ns >= _DOOR_NS:
            self._door_ns = now.mono_ns
            self._write_door(now)
        return outs

    def status(self) -> tuple[str, str]:
        """Report active while somebody operates."""
        lease = self._desk.lease
        who = f"{lease.name} operates" if lease else "nobody operates"
        log = self._disk.trouble and f"the log of acts is not written: {self._disk.trouble}"
        words = [f"{self.url}, {self._server.viewers} open, {who}", self._hint(), log, *self._left_out[:1]]
        return (ACTIVE if lease else READY), "; ".join(filter(None, words))

    def counters(self) -> dict[str, float]:
        """Report pictures, acts, and what was refused."""
        counts = self._server.counts
        return {
            "pictures": self._pictures,
            "bad_pictures": self._trouble_count,
            "acts_done": self._operation.done,
            "acts_refused": self._operation.refused,
            "requests_refused": counts.refused,
            "messages_malformed": counts.malformed,
            "connections_closed": counts.closed,
            "log_lines_lost": self._disk.lost,
        }

    def close(self) -> None:
        """Stop the server and finish a recording."""
        self._server.close()
        self._recording.close()
        self._disk.close()
        self._diary.close()
        with contextlib.suppress(OSError):
            (self._run_dir / DOOR).unlink(missing_ok=True)

    def _publications(self, twin: bool) -> tuple[str, ...]:
        if not self._operates:
            return (ARM,) if self._stops else ()
        attack = (SWITCH, *((FILE,) if self._catalogue else ()))
        return (TELEOP, ARM, ACT, *attack, *((RESET,) if twin else ()))

    def _show(self, topic: str, message: Any, info: MessageInfo, now: Now) -> None:
        """Send an image to the browsers that show it. Without one, nothing is compressed."""
        wanted = self._server.wanted()
        attacked = topic == _COMPOSITOR
        if not wanted & ({ATTACKED, POLICY} if attacked else {CAMERA}):
            return
        try:
            rgb = rgb_image(message, topic)
            pictures = {ATTACKED if attacked else CAMERA: rgb}
            if attacked and self._view is not None:
                pictures[POLICY] = self._view.image(rgb)
        except (MessageError, ValueError):
            self._trouble_count += 1
            return
        stamp = stamp_ns(message)
        for channel in wanted & pictures.keys():
            jpeg = jpeg_of(pictures[channel], self._config.picture_width_px, self._config.picture_quality)
            self._server.send_picture(Picture(channel, stamp, info.receive_mono_ns, jpeg))
            self._pictures += 1
        self._board.shown(stamp, now.real_ns)

    def _state(self, now: Now) -> dict[str, Any]:
        return {
            "t": "state",
            "real_ms": now.real_ns // 1_000_000,
            "viewers": self._server.viewers,
            "hint": self._hint(),
            "log_trouble": self._disk.trouble,
            **self._board.state(now),
            **self._operation.state(now),
        }

    def _welcome(self) -> dict[str, Any]:
        """First message for a new browser. Called by the server's thread, and reads only data that this thread may read."""
        return {
            "operates": self._operates,
            "stops": self._stops,
            "attacks": [entry.facts for entry in self._catalogue.values()],
            "policy_view": self._view is not None,
            **self._board.place(),
        }

    def _hint(self) -> str:
        if self._operates and self._holds is False:
            return "the safety node does not wait for a held button; launch with --set safety.teleop=hold to drive from the page"
        return ""

    def _png_of(self, attack_id: str) -> bytes | None:
        entry = self._catalogue.get(attack_id)
        return None if entry is None else entry.png

    def _write_door(self, now: Now) -> None:
        """Write address and code to a file that only this user can read. No secret goes on the bus, which is recorded.

        Nothing changes while the button is held, so that the operator's phone keeps the code that it shows.
        """
        if self._desk.held or not (self._server.renew_code(now.mono_ns) or self._door_is_new):
            return
        self._door_is_new = False
        tls = self._server.tls
        door = {
            "url": self.url,
            "code": self._server.doors.code if tls else "",
            "valid_until_s": round(now.real_s + self._config.code_s),
            "fingerprint": tls.fingerprint if tls else "",
        }
        text = json.dumps(door) + "\n"
        self._disk.submit(lambda: _write_door(self._run_dir / DOOR, text))


def _write_door(file: Path, text: str) -> None:
    file.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
    write_atomically(file, text)


if __name__ == "__main__":
    raise SystemExit(run_node_main(PageConfig, PageNode.build))
