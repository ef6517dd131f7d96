"""The operator's desk: who operates, whether the button is held, and the latched e-stop. Pure: times come as arguments.

A browser cannot keep the car driving by being late. The node numbers its beats and sends them to the operator's browser, which
answers each beat at once while the button is held. An answer counts by the age of the beat that
it names, on the node's own clock. So answers that waited in a network buffer are old when they arrive, and a browser that is
closed, hidden, frozen or cut off falls silent. A hold that ended never continues: the button must be pressed again.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass

from nodes.operator_page.config import PageConfig
from nodes.runtime.clock import NS_PER_S

_BEATS_KEPT = 64
STOPPED = "the emergency stop is latched; release it first"


@dataclass(frozen=True)
class Lease:
    """The right to operate.

    Attributes:
        client: Number of the connection that has it.
        session: Session of the browser; another connection of the same session may take over.
    """

    client: int
    name: str
    session: str = ""


class Desk:
    """Decides who operates and whether the button counts as held.

    Attributes:
        lease: The current lease; None while the desk is free.
        estop: Whether the e-stop is latched.
    """

    def __init__(self, limits: PageConfig) -> None:
        self.limits = limits
        self.lease: Lease | None = None
        self.estop = False
        self._beats: OrderedDict[int, int] = OrderedDict()
        self._beat = 0
        self._press: int | None = None
        self._last_client = self._last_press = 0
        self._answered_ns = self._picture_ns = self._acted_ns = 0

    @property
    def held(self) -> bool:
        """Whether the button counts as held."""
        return self._press is not None

    @property
    def press(self) -> int:
        """Number of the press that is held; 0 for none."""
        return self._press or 0

    @property
    def last_press(self) -> int:
        """Largest number of the operator's presses."""
        return self._last_press

    def beat(self, mono_ns: int) -> int:
        """Begin a beat and return its number."""
        self._beat += 1
        self._beats[self._beat] = mono_ns
        if len(self._beats) > _BEATS_KEPT:
            self._beats.popitem(last=False)
        return self._beat

    def take(self, client: int, name: str, mono_ns: int, session: str = "") -> str:
        """Give the desk to a client. Returns why not; empty if it has it now.

        A browser that lost its connection may take over from itself.
        """
        if self.lease is not None and self.lease.client != client:
            if not session or self.lease.session != session:
                return f"{self.lease.name} operates; one operator at a time"
            self.drop()
        if client != self._last_client:
            self._last_client, self._last_press = client, 0
        self.lease = Lease(client, name, session)
        self._acted_ns = mono_ns
        return ""

    def refusal(self, client: int) -> str:
        """Return why a client may not operate; empty if it may."""
        if self.lease is None:
            return "nobody operates; take control first"
        return "" if self.lease.client == client else f"{self.lease.name} operates; one operator at a time"

    def acted(self, client: int, mono_ns: int) -> None:
        """Note an act of a client. An act of the operator renews the lease."""
        if self.lease is not None and self.lease.client == client:
            self._acted_ns = mono_ns

    def leave(self, client: int) -> bool:
        """Free the desk if the client has it. Returns whether this let go of the button."""
        if self.lease is None or self.lease.client != client:
            return False
        self.lease = None
        return self.drop()

    def hold(self, client: int, beat: int, press: int, picture_ns: int, mono_ns: int) -> str:
        """Note that a client answered a beat while holding.

        Args:
            beat: Number of the beat that it answers.
            press: Number of the press, larger for every new one.
            picture_ns: Time at which the node received the picture on the client's screen [ns]; 0 without one.

        Returns:
            Why the button does not count as held; empty if it does.
        """
        if refusal := self.refusal(client):
            return refusal
        if press != self._press and press <= self._last_press:
            return "this press has ended; release the button and hold it again"
        sent_ns = self._beats.get(beat)
        if sent_ns is None or mono_ns - sent_ns > self.limits.hold_age_limit_s * NS_PER_S:
            return "the answer of the page is too old"  # it does not renew the hold, and `check` ends it
        if refusal := self._problem(picture_ns, mono_ns):
            self._last_press = max(self._last_press, press)
            self.drop()
            return refusal
        self._press = self._last_press = press
        self._answered_ns = max(self._answered_ns, sent_ns)
        self._picture_ns = picture_ns
        self._acted_ns = mono_ns
        return ""

    def release(self, client: int, press: int) -> bool:
        """Let go of the button. Returns whether it was held."""
        if self.lease is None or self.lease.client != client:
            return False
        self._last_press = max(self._last_press, press)
        return self.drop()

    def drop(self) -> bool:
        """End the current hold. Returns whether the button was held."""
        held, self._press = self.held, None
        return held

    def stop(self) -> bool:
        """Latch the e-stop. Returns whether the button was held."""
        self.estop = True
        return self.drop()

    def reset(self, client: int) -> str:
        """Unlatch the e-stop. Returns why not; empty if it was done."""
        if refusal := self.refusal(client):
            return refusal
        if not self.estop:
            return "the emergency stop is not latched"
        self.estop = False
        return ""

    def check(self, mono_ns: int) -> str:
        """End a hold that is not answered any more, and a lease that is not used. Returns why a hold ended; empty if none did."""
        if self._press is not None:
            ended = ""
            age_s = (mono_ns - self._answered_ns) / NS_PER_S
            if age_s > self.limits.hold_age_limit_s:
                ended = f"the page has not answered for {age_s:.2f} s"
            else:
                ended = self._problem(self._picture_ns, mono_ns)
            if ended:
                self.drop()
            return ended
        if self.lease is not None and mono_ns - self._acted_ns > self.limits.lease_s * NS_PER_S:
            self.lease = None
        return ""

    def left_s(self, mono_ns: int) -> float:
        """Time until an unused lease ends [s]; 0 while the desk is free."""
        if self.lease is None:
            return 0.0
        return max(0.0, self.limits.lease_s - (mono_ns - self._acted_ns) / NS_PER_S)

    def _problem(self, picture_ns: int, mono_ns: int) -> str:
        if self.estop:
            return STOPPED
        if not picture_ns:
            return "the page has shown no picture yet"
        age_s = (mono_ns - picture_ns) / NS_PER_S
        if age_s > self.limits.picture_age_limit_s:
            return f"the picture on the page is {age_s:.1f} s old"
        return ""
