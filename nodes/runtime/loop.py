"""The loop that runs a node: sockets, schedule and status messages."""

from __future__ import annotations

import contextlib
import os
import sys
import threading

import numpy as np

from nodes.runtime.bus import Bus
from nodes.runtime.clock import NS_PER_S, Clock, Now
from nodes.runtime.descriptors import Reserve
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import header, types
from nodes.runtime.node import FAULT, Node, Out
from nodes.runtime.topics import STATUS_RATE_HZ, status_topic

_IDLE_S = 1.0


class Schedule:
    """Due times of a periodic task on an absolute grid. After a stall, missed ticks are skipped instead of run in a burst.

    Args:
        start_ns: First due time on the monotonic clock [ns].
    """

    def __init__(self, rate_hz: float, start_ns: int) -> None:
        if not rate_hz > 0:
            raise ValueError(f"expected a rate > 0 Hz, got {rate_hz}")
        self._period_ns = round(NS_PER_S / rate_hz)
        self.next_ns = start_ns
        self.done = 0
        self.missed = 0
        self.worst_lag_s = 0.0

    def due(self, mono_ns: int) -> bool:
        """Whether a tick is due. If so, the due time moves to the next point of the grid in the future."""
        if mono_ns < self.next_ns:
            return False
        behind = (mono_ns - self.next_ns) // self._period_ns
        self.worst_lag_s = max(self.worst_lag_s, (mono_ns - self.next_ns) / NS_PER_S)
        self.missed += behind
        self.done += 1
        self.next_ns += (behind + 1) * self._period_ns
        return True


class NodeLoop:
    """Runs one node on a bus until `stop`.

    Args:
        name: Name of the node in the launch file.
        node: The node; the loop does not close it.
        bus: The node's bus, on which the loop opens the node's sockets.
    """

    def __init__(self, name: str, node: Node, bus: Bus, clock: Clock) -> None:
        self.name = name
        self._node = node
        self._bus = bus
        self._clock = clock
        self._stop_read, self._stop_write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
        self._stopping = False
        # The loop may close its pipe while another thread is about to write to it. A signal handler may run in between in the
        # same thread, so the lock is reentrant.
        self._ending = threading.RLock()
        self._refusals: dict[str, str] = {}
        self._stated = ""
        self._reserve = Reserve()
        start_ns = clock.now().mono_ns
        self._status_schedule = Schedule(STATUS_RATE_HZ, start_ns)
        self._tick_schedule = Schedule(node.tick_rate_hz, start_ns) if node.tick_rate_hz else None
        for topic in node.publications:
            bus.publisher(topic)
        for topic in node.subscriptions:
            bus.subscribe(topic, node.queues.get(topic))
        bus.watch(self._stop_read)
        if node.inbox is not None:
            bus.watch(node.inbox.fileno())

    @property
    def wakeup_fd(self) -> int:
        """File descriptor for ``signal.set_wakeup_fd``: writing a byte to it ends the current wait."""
        return self._stop_write

    def stop(self) -> None:
        """Make `run` return soon (any thread or signal handler)."""
        with self._ending:
            if self._stopping:
                return
            self._stopping = True
            with contextlib.suppress(BlockingIOError):  # the pipe is full, so the loop will wake up anyway
                os.write(self._stop_write, b"s")

    def run(self) -> None:
        """Run the node until `stop`. Exceptions of the node are raised here."""
        while not self._stopping:
            self._bus.wait(self._time_to_next_s())
            self._handle_messages()
            self._handle_inbox()
            now = self._clock.now()
            if self._tick_schedule is not None and self._tick_schedule.due(now.mono_ns):
                self._publish(self._node.tick(now))
            state, text = self._node.status()
            if shortage := self._reserve.check():
                state, text = FAULT, shortage
            # A change of state is published at once, because the safety node acts on it.
            if self._status_schedule.due(now.mono_ns) or state != self._stated:
                self.publish_status(now, state, text)

    def close(self) -> None:
        """Close the loop's own file descriptors. Call it after the bus is closed; `stop` then does nothing."""
        with self._ending:
            self._stopping = True
            self._reserve.close()
            os.close(self._stop_read)
            os.close(self._stop_write)

    def publish_status(self, now: Now, state: str, text: str) -> None:
        """Publish the node's status with all counters."""
        self._stated = state
        counters = self._counters()
        publications = list(self._node.publications)
        status = types.NodeStatus(
            header=header(now.real_ns),
            node=self.name,
            pid=os.getpid(),
            state=state,
            text=text,
            subscriptions=list(self._node.subscriptions),
            publications=publications,
            subscribers=np.array([self._bus.subscribers(t) for t in publications], dtype=np.uint32),
            counter_names=list(counters),
            counter_values=np.array(list(counters.values()), dtype=np.float64),
        )
        self._bus.publish(status_topic(self.name), status)

    def _time_to_next_s(self) -> float:
        next_ns = self._status_schedule.next_ns
        if self._tick_schedule is not None:
            next_ns = min(next_ns, self._tick_schedule.next_ns)
        return min(_IDLE_S, max(0.0, (next_ns - self._clock.now().mono_ns) / NS_PER_S))

    def _handle_messages(self) -> None:
        for received in self._bus.receive():
            message = None
            if not self._node.raw:
                try:
                    message = received.message()
                except MessageError as error:
                    self._bus.refuse(received.topic, str(error))
                    continue
            self._publish(self._node.handle(received.topic, message, received.info, self._clock.now()))
        refusals = self._bus.refusals()
        if refusals != self._refusals:
            self._refusals = refusals
            print(f"{self.name}: refused {'; '.join(refusals.values())}", file=sys.stderr, flush=True)

    def _handle_inbox(self) -> None:
        if self._node.inbox is not None:
            for item in self._node.inbox.take():
                self._publish(self._node.receive(item, self._clock.now()))

    def _publish(self, outs: list[Out]) -> None:
        for topic, message in outs:
            if topic not in self._node.publications:
                raise MessageError(
                    f"{self.name} sends {topic}, but declares only {', '.join(self._node.publications)}"
                )
            self._bus.publish(topic, message)

    def _counters(self) -> dict[str, float]:
        counters: dict[str, float] = {}
        if self._tick_schedule is not None:
            counters |= {"ticks": self._tick_schedule.done, "ticks_missed": self._tick_schedule.missed}
            counters["tick_worst_lag_s"] = self._tick_schedule.worst_lag_s
        if self._node.inbox is not None:
            counters["inbox_dropped"] = self._node.inbox.dropped
        for topic, counts in self._bus.counts().items():
            counters[f"received {topic}"] = counts.received
            for word in ("dropped", "lost", "refused"):
                if count := getattr(counts, word):
                    counters[f"{word} {topic}"] = count
        return counters | self._node.counters()
