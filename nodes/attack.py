"""The attack node: takes a request, searches in a separate process, and ends with the attack file on the bus.

The search may take hours. The node's loop meanwhile answers a cancel at once and reports its health. Each step is on disk
before it begins, so a node that was killed continues with the same request when it is started in the same run folder.
The file is sent in pieces several times, and once more for every new subscriber.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from advnerf_core.attack.artifact import AttackFile, load_attack
from advnerf_core.attack.objectives import CTE
from advnerf_core.documents import read_json
from advnerf_core.errors import AdvnerfError
from advnerf_core.files import write_atomically
from advnerf_core.plugins import in_one_line
from advnerf_core.strict import StrictModel
from nodes.experiment.node.job import REQUEST, Job, Said, is_begun
from nodes.experiment.node.request import parse_request
from nodes.runtime.clock import NS_PER_S
from nodes.runtime.messages import header, image_message, types
from nodes.runtime.node import ACTIVE, READY, Inbox, MessageInfo, Node, NodeContext, Now, Out
from nodes.runtime.process import run_node_main
from nodes.runtime.requests import Answer, AnswerMemory
from nodes.runtime.transfer import FileSender, chunk_messages

_REQUEST, _CANCEL = "/attack/request", "/attack/cancel"
_PROGRESS, _FILE = "/attack/progress", "/attack/file"
_IMAGES = {"texture": "/attack/texture", "preview": "/attack/preview"}
_ID = re.compile(r"[A-Za-z0-9][A-Za-z0-9_-]{0,39}")
_CURRENT = "current.json"
_TELL_NS = NS_PER_S
_INBOX = 1000
RUNNING = ("preparing", "searching")


class AttackNodeConfig(StrictModel):
    """Configuration of the attack node.

    Attributes:
        folder: Folder of requests, states and attack files, with one folder each; relative to the run folder.
        sends: Times a finished attack file is sent.
        repeat_s: Pause between two sends [s].
        threads: Threads of the search; 0 leaves it to the libraries.
    """

    folder: Path = Path("attack")
    sends: int = Field(default=3, ge=1)
    repeat_s: float = Field(default=2.0, ge=0.0)
    threads: int = Field(default=0, ge=0)


class AttackNode(Node):
    """Takes requests; publishes progress, pictures and the attack file."""

    opens = "a process for the search"
    subscriptions = (_REQUEST, _CANCEL)
    publications = (_PROGRESS, *_IMAGES.values(), _FILE)
    tick_rate_hz = 20.0

    def __init__(
        self, config: AttackNodeConfig, folder: Path, subscribers: Callable[[str], int] = lambda topic: 0
    ) -> None:
        self.inbox: Inbox[Said] = Inbox(_INBOX)
        self._config, self._folder, self._subscribers = config, folder, subscribers
        self._job: Job | None = None
        self._request_id = ""
        self._progress: dict[str, Any] = {}
        self._told_ns = 0
        self._sender: FileSender | None = None
        self._answers = AnswerMemory()
        self._resume()

    @classmethod
    def build(cls, config: AttackNodeConfig, context: NodeContext) -> AttackNode:
        """Make the node of a process; it continues with the request it had when it was killed."""
        folder = context.run_dir.resolve() / config.folder
        folder.mkdir(parents=True, exist_ok=True)
        return cls(config, folder, context.subscribers)

    def handle(self, topic: str, message: Any, info: MessageInfo, now: Now) -> list[Out]:
        """Take a request or a cancel, once, and answer every repeat of it."""
        ask_id = str(message.ask_id)
        if not self._answers.repeat(ask_id):
            self._answers.give(Answer(ask_id, *self._decide(topic, message)))
        answer = self._answers.last
        if answer.granted:
            return [self._tell(now)]
        return [self._message(now, str(message.request_id), _fresh("refused", answer.text))]

    def receive(self, item: Said, now: Now) -> list[Out]:
        """Take a report of the search; reports of an earlier search are ignored."""
        if item.job is not self._job:
            return []
        if item.kind == "progress":
            data = {name: value for name, value in item.data.items() if value is not None}
            best_m = max(self._progress["best_total_cte_m"], data.get("total_cte_m", 0.0))
            best = float(np.fmax(self._progress["best_value"], data.get("value", math.nan)))
            self._progress |= {**data, "best_total_cte_m": best_m, "best_value": best}
            self._progress.pop("bytes", None)
        elif item.kind == "image":
            pixels = np.frombuffer(item.pixels, np.uint8).reshape(item.data["height"], item.data["width"], 3)
            return [
                Out(_IMAGES[item.data["name"]], image_message(pixels, now.real_ns, self._request_id[:40]))
            ]
        elif item.kind == "done":
            self._keep("done", file=item.data["file"])
            self._finish("done", f"{item.data['file']}", attack_id=item.data["attack_id"])
            self._begin_sending(Path(item.data["file"]), now)
        elif item.kind == "ended" and self._progress["state"] in RUNNING:
            why = item.job.why_it_failed()
            self._keep("failed")
            self._finish("failed", why)
        return [self._tell(now)]

    def tick(self, now: Now) -> list[Out]:
        """Publish the progress regularly, and send a piece of the file."""
        outs = [self._tell(now)] if now.mono_ns - self._told_ns >= _TELL_NS else []
        if (
            self._sender is not None
            and (piece := self._sender.next(now.mono_ns, self._subscribers(_FILE))) is not None
        ):
            outs.append(Out(_FILE, piece))
        return outs

    def status(self) -> tuple[str, str]:
        """Active during a search."""
        if not self._request_id:
            return READY, "waiting for a request"
        state, p = self._progress["state"], self._progress
        text = f"{self._request_id}: {state}"
        if self._job is None:
            return READY, f"{text} {p['text']}".strip()
        return ACTIVE, f"{text} {p['evaluation']}/{p['evaluations']}, best {p['best_value']:.4g} {p['unit']}"

    def counters(self) -> dict[str, float]:
        """Evaluations of the present search, and its process id."""
        job = {"worker_pid": float(self._job.pid)} if self._job is not None else {}
        return {"evaluation": float(self._progress.get("evaluation", 0)), **job}

    def close(self) -> None:
        """End the search; its request stays the current one, so that the next node continues it."""
        if self._job is not None:
            self._job.stop()
            self._job = None

    def _decide(self, topic: str, message: Any) -> tuple[bool, str]:
        try:
            self._cancel(message) if topic == _CANCEL else self._accept(message)
        except (AdvnerfError, OSError) as error:
            return False, " ".join(str(error).split())
        return True, ""

    def _accept(self, message: Any) -> None:
        request_id, text = str(message.request_id), str(message.request)
        if not _ID.fullmatch(request_id):
            raise AdvnerfError(
                f"expected a request id of 1 to 40 letters, digits, - and _, got {request_id!r}"
            )
        kept_text = parse_request(text, f"request {request_id}")
        if self._job is not None and request_id != self._request_id:
            raise AdvnerfError(f"busy with {self._request_id}; wait for it, or cancel it")
        folder = self._folder / request_id
        kept = folder / REQUEST
        other = kept.exists() and kept.read_text(encoding="utf-8") != kept_text
        if other and (self._job is not None or is_begun(folder)):
            raise AdvnerfError(f"{request_id} is another request already; give this one another id")
        if self._job is not None:
            return  # the very same request again
        write_atomically(kept, kept_text)
        self._start(request_id)

    def _start(self, request_id: str) -> None:
        self._request_id, self._progress, self._sender = request_id, _fresh("preparing", ""), None
        self._keep("running")
        self._job = Job(self._folder / request_id, self.inbox, self._config.threads)

    def _cancel(self, message: Any) -> None:
        wanted, running = str(message.request_id), self._job is not None
        if not wanted and not running:
            raise AdvnerfError("nothing to cancel: none is running")
        if wanted not in ("", self._request_id):
            other = f"{self._request_id} is running and goes on" if running else "none is running"
            raise AdvnerfError(f"expected the search {wanted} to cancel it; {other}")
        if running:
            self._keep("cancelled")
            self._finish("cancelled", str(message.reason))

    def _finish(self, state: str, text: str, attack_id: str = "") -> None:
        self._progress |= {"state": state, "text": text, "attack_id": attack_id}
        self.close()

    def _begin_sending(self, file: Path, now: Now) -> None:
        attack = load_attack(file)
        chunks = chunk_messages(file.read_bytes(), attack.attack_id, now.real_ns)
        self._sender = FileSender(chunks, self._config.sends, round(self._config.repeat_s * NS_PER_S))

    def _keep(self, state: str, **more: str) -> None:
        content = {"request_id": self._request_id, "state": state, **more}
        write_atomically(self._folder / _CURRENT, json.dumps(content) + "\n")

    def _resume(self) -> None:
        """Continue an interrupted search, and send again a finished file. What was changed or deleted since must not keep the node from other requests."""
        if not (current := self._folder / _CURRENT).exists():
            return
        try:
            self._go_on(read_json(current))
        except (AdvnerfError, OSError, LookupError, TypeError, ValueError) as error:
            text = f"before this start; cannot go on with it: {in_one_line(error)}"
            self._progress = _fresh("failed", text)

    def _go_on(self, current: dict[str, str]) -> None:
        if current["state"] == "running":
            self._start(current["request_id"])
            return
        self._request_id, self._progress = (
            current["request_id"],
            _fresh(current["state"], "before this start"),
        )
        if current["state"] == "done" and Path(current["file"]).is_file():
            attack = load_attack(current["file"])
            best = attack.predicted_total_cte_m or 0.0
            self._progress |= {"attack_id": attack.attack_id, "best_total_cte_m": best}
            self._progress |= _objective_of(attack)
            if attack.clean_drive is not None:
                clean = attack.clean_drive
                self._progress |= {"clean_total_cte_m": clean.mean_total_cte_m, "clean_drives": clean.drives}
            self._begin_sending(Path(current["file"]), Now(0, 0))

    def _tell(self, now: Now) -> Out:
        self._told_ns = now.mono_ns
        return self._message(now, self._request_id, self._progress or _fresh("idle", ""))

    def _message(self, now: Now, request_id: str, progress: dict[str, Any]) -> Out:
        return Out(
            _PROGRESS,
            types.AttackProgress(
                header=header(now.real_ns),
                request_id=request_id,
                answered_id=self._answers.last.ask_id,
                **progress,
            ),
        )


def _objective_of(attack: AttackFile) -> dict[str, Any]:
    """Objective, unit and values of a finished attack."""
    clean = math.nan if attack.clean_drive is None else attack.clean_drive.mean_total_cte_m
    found = attack.extra.get("objective", {"name": CTE, "unit": "m", "clean_value": clean})
    return {
        "objective": found["name"],
        "unit": found["unit"],
        "best_value": math.nan if attack.value is None else attack.value,
        "clean_value": found.get("clean_value", math.nan),
    }


def _fresh(state: str, text: str) -> dict[str, Any]:
    return {
        "state": state,
        "text": text,
        "seed": 0,
        "evaluation": 0,
        "evaluations": 0,
        "loss_m": math.nan,
        "total_cte_m": 0.0,
        "best_total_cte_m": 0.0,
        "clean_total_cte_m": math.nan,
        "clean_drives": False,
        "objective": "",
        "unit": "",
        "value": math.nan,
        "best_value": math.nan,
        "clean_value": math.nan,
        "seconds": 0.0,
        "attack_id": "",
    }


if __name__ == "__main__":
    raise SystemExit(run_node_main(AttackNodeConfig, AttackNode.build))
