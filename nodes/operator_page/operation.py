"""Decides each act of a browser, logs it, and turns it into messages. Times come as arguments.

The desk decides who operates and whether the button counts as held. The safety node decides whether the car may move.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

from advnerf_core.geometry import planar_pose
from nodes.control.interlock import ATTACK_SWITCH, switched_off_by
from nodes.launching.launched import Launched
from nodes.operator_page.board import ViewState
from nodes.operator_page.catalogue import CatalogueEntry
from nodes.operator_page.client import ClientAct
from nodes.operator_page.desk import STOPPED, Desk
from nodes.operator_page.diary import Diary
from nodes.operator_page.recording import LAUNCH_RECORDER, TELEOP, RecorderControl
from nodes.operator_page.said import ChooseAttack, Hold, Label, Release, Stop, Take
from nodes.operator_page.trial import RUNNING, Trial
from nodes.runtime.arm_asker import ArmAsker
from nodes.runtime.clock import NS_PER_S, Now
from nodes.runtime.messages import header, pose_message, stamp_from_ns, types
from nodes.runtime.node import Out
from nodes.runtime.requests import ESTOP_LATCHED
from nodes.runtime.transfer import FileSender, chunk_messages
from nodes.runtime.wire import MessageInfo

ACT, RESET, SWITCH, FILE = "/operator/act", "/twin/reset", ATTACK_SWITCH, "/attack/file"
_TELEOP_NS = NS_PER_S // 20
_SWITCH_NS = NS_PER_S // 2
# The e-stop's release and the request to re-arm travel on different topics, so the request waits.
_REARM_NS = 120_000_000
_TAKEN_S = 8.0
# An attack file is sent so often, because its receiver may start in the middle.
_FILE_ROUNDS = 3
_IDLE, _AUTONOMY = "idle", "autonomy"
_ONLY_WATCHES = "this page only watches"
_RECORDING = "this page shows a recording, which has no car to stop"


@dataclass
class Operation:
    """Decides acts.

    Attributes:
        desk: Lease, button and e-stop.
        recording: The recorder that the operator starts.
        catalogue: Attacks by id.
        start_pose: Start of a trial: x [m], y [m], yaw [rad]; None without a room.
        operates: Whether the page may do more than show and stop the car.
        answer: Sends the answer to an act to a browser, by the number of its connection.
    """

    desk: Desk
    board: ViewState
    diary: Diary
    trial: Trial
    recording: RecorderControl
    catalogue: Mapping[str, CatalogueEntry]
    launched: Launched
    start_pose: tuple[float, float, float] | None
    operates: bool
    answer: Callable[[int, dict[str, Any]], None]

    def __post_init__(self) -> None:
        self._asker = ArmAsker()
        self._told: tuple[str, bool] | None = None
        self._told_ns = self._switched_ns = 0
        self._show: bool | None = None
        self._switched_by = ""
        self._sender: FileSender | None = None
        self._chosen, self._chosen_ns = "", 0
        self._rearm_ns: int | None = None
        self._refused_press = (0, 0)
        self._why_ended = ""
        self._knows_latch = self._was_armed = False
        self.done = self.refused = 0

    def obey(self, asked: ClientAct, now: Now) -> list[Out]:
        """Decide an act, log it, and answer it."""
        act = asked.act
        if isinstance(act, Stop):
            refusal = "" if self.operates or self.launched.known else _RECORDING
            outs = [] if refusal else self._stop(asked, act, now)
            return [*outs, *self._note(asked, act.t, "", refusal, now)]
        if isinstance(act, Hold):
            return self._hold(asked, act, now)
        name, detail = act.t, ""
        outs = []
        if not self.operates:
            refusal = _ONLY_WATCHES
        elif not isinstance(act, Take) and (found := self.desk.refusal(asked.client)):
            refusal = found
        else:
            self.desk.acted(asked.client, now.mono_ns)
            refusal, detail, outs = self._do(asked, now)
        return [*outs, *self._note(asked, name, detail, refusal, now)]

    def gone(self, client: int, now: Now) -> list[Out]:
        """Note that a browser has gone. If it held the button, the car stops at once."""
        lease = self.desk.lease
        if not self.desk.leave(client) or lease is None:
            return []
        return self._ended("the page was closed or lost its connection", lease.name, now)

    def heard_safety(self, message: Any, info: MessageInfo) -> None:
        """Note a state of the safety node. A page that starts takes over the e-stop that is latched there."""
        self._asker.heard(message, info)
        if self.operates and not self._knows_latch:
            self._knows_latch = True
            if message.reason == ESTOP_LATCHED:
                self.desk.stop()

    def heard_label(self) -> None:
        """Note a label of the node that shows the attack. Until somebody chooses here, an attack that was switched off stays so.

        A page that starts repeats that, as the page did on which it was chosen. One that only watches follows the labels.
        """
        by = switched_off_by(str(getattr(self.board.label, "reason", "")))
        if not self.operates:
            self._show = not by
        elif self._show is None and by:
            self._show, self._switched_by = False, by

    def heard_motor(self, message: Any, info: MessageInfo) -> None:
        """Note a report of the motor node."""
        self._asker.heard_motor(message, info)

    def follow(self, now: Now) -> list[Out]:
        """Continue a trial with what the board has just heard, and let go of the button at its end."""
        seen = self.board.seen()
        if self.trial.step(replace(seen, reason=self._why_ended or seen.reason), now.mono_ns):
            return self._end_trial("the trial is over", now)
        return []

    def stops(self) -> tuple[int, int]:
        """Number of requests to disarm, and the number up to which they are confirmed (any thread)."""
        return self._asker.stops_asked, self._asker.stops_confirmed

    def tick(self, now: Now) -> list[Out]:
        """Check the button, and repeat what has to be repeated."""
        if not self.operates:
            return self._asker.tick(now)
        outs: list[Out] = []
        lease = self.desk.lease
        if ended := self.desk.check(now.mono_ns):
            outs += self._ended(ended, lease.name if lease else "", now)
        outs += self.follow(now)
        if self._rearm_ns is not None and now.mono_ns >= self._rearm_ns:
            self._rearm_ns = None
            self._asker.arm(now, "e-stop reset on the page")
        self.recording.check()
        outs += self._arming(now)
        return [*outs, *self._teleop(now), *self._asker.tick(now), *self._attack(now)]

    def state(self, now: Now) -> dict[str, Any]:
        """Describe the desk and what was asked, for the page."""
        return {
            "lease": self._lease(now),
            "held": self.desk.held,
            "press": self.desk.press,
            "ended": self._why_ended,
            "estop": self.desk.estop,
            "unanswered_s": round(self._asker.unanswered_s(now), 1),
            "not_confirmed": self._asker.not_confirmed(now),
            "stops": list(self.stops()),
            "chosen": {
                "id": self._chosen,
                "show": self._show is not False,
                "trouble": self._transfer_trouble(now),
            },
            "trial": self.trial.state(),
            "recording": self.recording.state(),
            "acts": self.diary.last,
        }

    def _lease(self, now: Now) -> dict[str, Any] | None:
        lease = self.desk.lease
        if lease is None:
            return None
        left_s = round(self.desk.left_s(now.mono_ns))
        return {"client": lease.client, "session": lease.session, "name": lease.name, "left_s": left_s}

    def _hold(self, asked: ClientAct, act: Hold, now: Now) -> list[Out]:
        """Note an answered beat. The first of a press is an act; the rest only keep it alive."""
        desk, was_held = self.desk, self.desk.held
        refusal = (
            desk.hold(asked.client, act.beat, act.press, asked.picture_ns, now.mono_ns)
            if self.operates
            else _ONLY_WATCHES
        )
        if refusal and was_held and not desk.held:
            return self._ended(refusal, self._name(asked), now)
        if refusal:
            if (asked.client, act.press) == self._refused_press:
                return []
            self._refused_press = (asked.client, act.press)
            return self._note(asked, "hold", "", refusal, now)
        if was_held:
            return []
        self._why_ended = ""
        return [*self._teleop(now), *self._note(asked, "hold", "", "", now)]

    def _do(self, asked: ClientAct, now: Now) -> tuple[str, str, list[Out]]:
        """Do an act of somebody who may. Returns why not, what it was about, and messages."""
        act = asked.act
        if isinstance(act, Take):
            refusal = self.desk.take(asked.client, act.name, now.mono_ns, asked.session)
            return refusal, act.name, self._teleop(now)
        if isinstance(act, Release):
            self.desk.release(asked.client, act.press)
            return "", "", self._teleop(now)
        if isinstance(act, ChooseAttack):
            return self._choose(act.id, asked, now), act.id, []
        if isinstance(act, Label):
            return self._label_refusal(now), act.text, []
        do = {
            "leave": self._leave,
            "reset_estop": self._reset,
            "trial": self._start_trial,
            "trial_end": self._give_up_trial,
            "attack_off": self._attack_off,
            "record": self._record,
            "record_stop": self._record_stop,
        }[act.t]
        refusal, outs = do(asked, now)
        return refusal, "", outs

    def _leave(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        self.desk.leave(asked.client)
        return "", self._teleop(now)

    def _stop(self, asked: ClientAct, act: Stop, now: Now) -> list[Out]:
        """Stop the car. Every admitted browser may do so; no rule of the desk applies. The e-stop stays latched."""
        self.desk.acted(asked.client, now.mono_ns)
        self._rearm_ns = None
        name = self._name(asked)
        if not self.operates:
            return [self._asker.disarm(now, f"{act.t} on a page that watches, by {name}")]
        if act.t == "estop":
            self._knows_latch = True
            self.desk.stop()
            return [*self._teleop(now), self._asker.disarm(now, f"e-stop on the page by {name}")]
        self.desk.drop()
        return [self._asker.disarm(now, f"on the page by {name}"), *self._teleop(now)]

    def _reset(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        """Release the e-stop. The safety node forgets its latch only at an explicit request of the operator.

        Without a held button that request cannot arm the car. So it is only sent if the safety node requires the button.
        """
        refusal = self.desk.reset(asked.client)
        if not refusal and self.launched.holds:
            self._rearm_ns = now.mono_ns + _REARM_NS
        return refusal, self._teleop(now)

    def _start_trial(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        """Begin a trial. The simulated car is put to the start; a real one must be carried there."""
        if self.board.armed or self.desk.held:
            return "the car is armed; release the button first", []
        if self.desk.estop:
            return STOPPED, []
        self.trial.start()
        if not (self.launched.twin and self.start_pose):
            return "", []
        return "", [Out(RESET, pose_message(planar_pose(*self.start_pose), now.real_ns))]

    def _give_up_trial(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        if not self.trial.end():
            return "no trial is running", []
        return "", self._end_trial("the trial was ended", now)

    def _end_trial(self, why: str, now: Now) -> list[Out]:
        lease = self.desk.lease
        if self.desk.drop():
            return self._ended(why, lease.name if lease else "", now)
        return []

    def _choose(self, attack_id: str, asked: ClientAct, now: Now) -> str:
        entry = self.catalogue.get(attack_id)
        if refusal := self._switch_refusal():
            return refusal
        if entry is None:
            return f"no attack {attack_id} among the {len(self.catalogue)} of this page"
        try:
            chunks = chunk_messages(entry.file.read_bytes(), attack_id, now.real_ns)
        except (OSError, ValueError) as error:
            return f"cannot read {entry.file.name}: {error}"
        self._sender = FileSender(chunks, _FILE_ROUNDS, NS_PER_S)
        self._chosen, self._chosen_ns = attack_id, now.mono_ns
        self._switch(True, asked)
        return ""

    def _attack_off(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        if refusal := self._switch_refusal():
            return refusal, []
        self._switch(False, asked)
        return "", self._attack(now)

    def _switch_refusal(self) -> str:
        """Return why another attack would spoil what is measured; empty if it would not."""
        return "a trial is running, of one attack; end it first" if self.trial.phase == RUNNING else ""

    def _switch(self, show: bool, asked: ClientAct) -> None:
        self._show, self._switched_by, self._switched_ns = show, self._name(asked), 0

    def _record(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        return self.recording.start(), []

    def _record_stop(self, asked: ClientAct, now: Now) -> tuple[str, list[Out]]:
        return self.recording.stop(), []

    def _label_refusal(self, now: Now) -> str:
        """Return why a label would be lost; empty if a recorder keeps it."""
        if self.recording.records or self.board.hears(LAUNCH_RECORDER, now):
            return ""
        if self.recording.starting:
            return "the recorder is still starting; label again in a second"
        return "nothing is being recorded, so the label would be lost; start recording first"

    def _ended(self, why: str, name: str, now: Now) -> list[Out]:
        """A hold ended by itself: report it before anything else."""
        self._why_ended = why
        if lease := self.desk.lease:
            # Late answers to this press are not logged as separate acts.
            self._refused_press = (lease.client, self.desk.last_press)
        return [*self._teleop(now), self._log(now, name, "let_go", why)]

    def _arming(self, now: Now) -> list[Out]:
        """Log who armed the car: the person whose held button the safety node has accepted."""
        lease, was_armed = self.desk.lease, self._was_armed
        self._was_armed = self.board.armed
        if was_armed or not self._was_armed or lease is None or not self.desk.held:
            return []
        return [self._log(now, lease.name, "armed", "")]

    def _note(self, asked: ClientAct, act: str, detail: str, refusal: str, now: Now) -> list[Out]:
        self.done += not refusal
        self.refused += bool(refusal)
        out = self._log(now, self._name(asked), act, detail, asked, refusal)
        self.answer(asked.client, {"t": "answer", "act": act, "n": asked.act.n, "refused": refusal})
        return [out] if self.operates else []

    def _log(
        self, now: Now, name: str, act: str, detail: str, asked: ClientAct | None = None, refusal: str = ""
    ) -> Out:
        address, frame_ns = (asked.address, asked.frame_ns) if asked else ("", 0)
        self.diary.note(now, name, address, act, detail, frame_ns, refusal)
        message = types.OperatorAct(
            header=header(now.real_ns),
            operator=name,
            address=address,
            act=act,
            detail=detail,
            seen=stamp_from_ns(frame_ns),
            granted=not refusal,
            answer=refusal,
        )
        return Out(ACT, message)

    def _teleop(self, now: Now) -> list[Out]:
        """Report the button and the e-stop at every change, and 20 times a second."""
        desk = self.desk
        said = (_AUTONOMY if desk.held else _IDLE, desk.estop)
        if said == self._told and now.mono_ns - self._told_ns < _TELEOP_NS:
            return []
        self._told, self._told_ns = said, now.mono_ns
        message = types.Teleop(
            header=header(now.real_ns),
            mode=said[0],
            estop=said[1],
            speed_mps=0.0,
            steering_rad=0.0,
            device=f"page: {desk.lease.name}" if desk.lease else "page",
        )
        return [Out(TELEOP, message)]

    def _attack(self, now: Now) -> list[Out]:
        """Send a piece of a chosen attack, and twice a second whether it may be shown."""
        outs = []
        if self._show is not None and now.mono_ns - self._switched_ns >= _SWITCH_NS:
            self._switched_ns = now.mono_ns
            outs.append(
                Out(
                    SWITCH,
                    types.AttackSwitch(header=header(now.real_ns), show=self._show, source=self._switched_by),
                )
            )
        if self._sender is not None and (piece := self._sender.next(now.mono_ns)) is not None:
            outs.append(Out(FILE, piece))
        return outs

    def _transfer_trouble(self, now: Now) -> str:
        """Why a chosen attack has not arrived; empty if it has, or may still."""
        label = self.board.label
        if not self._chosen or (label is not None and label.attack_id == self._chosen):
            return ""
        if now.mono_ns - self._chosen_ns < _TAKEN_S * NS_PER_S:
            return "sending"
        said = "; ".join(filter(None, (self.board.status_text(name) for name in ("compositor", "monitor"))))
        return f"not taken over: {said or 'no compositor or monitor node reports'}"

    def _name(self, asked: ClientAct) -> str:
        lease = self.desk.lease
        return lease.name if lease is not None and lease.client == asked.client else asked.name
