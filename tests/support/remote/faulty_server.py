"""``serve.py`` that misbehaves once, on request: ``fault.json`` beside the simulator names a call, a kind of fault, and how many calls later.

It is a real process that really dies, hangs and lies; the tests and ``benchmarks/world_faults.py`` start it in place of ``serve.py``.
"""

import importlib.util
import json
import os
import signal
import sys
import time
from pathlib import Path

import numpy as np

SERVE = Path(__file__).resolve().parents[3] / "hardware" / "worlds" / "servers" / "serve.py"
spec = importlib.util.spec_from_file_location("serve", SERVE)
serve = importlib.util.module_from_spec(spec)
spec.loader.exec_module(serve)


class Faulty(serve.Server):
    """Its answer to the call that ``fault.json`` names is a fault; what was planned once happens once."""

    def answer(self, header, arrays):
        self.fault = None
        plan = Path(sys.argv[1]).parent / "fault.json"
        if plan.exists():
            wanted = json.loads(plan.read_text())
            if wanted["call"] == header["call"]:
                wanted["after"] -= 1
                plan.write_text(json.dumps(wanted))
                if wanted["after"] < 0:
                    plan.unlink()
                    self.fault = wanted["kind"]
        if self.fault in BEFORE:
            BEFORE[self.fault]()
        reply, given = super().answer(header, arrays)
        if self.fault in CHANGES:
            given = {key: np.array(value) for key, value in given.items()}
            CHANGES[self.fault](reply, given)
        return reply, given

    def send(self, header, arrays):
        if self.fault in SENT:
            SENT[self.fault](self, header, arrays)
        else:
            super().send(header, arrays)


def crash():
    os.kill(os.getpid(), signal.SIGSEGV)


def stop():
    os.kill(os.getpid(), signal.SIGSTOP)


BEFORE = {
    "exit": lambda: os._exit(3),
    "killed": lambda: os.kill(os.getpid(), signal.SIGKILL),
    "crash": crash,
    "stopped": stop,
    "hang": lambda: time.sleep(3600),
    "late": lambda: time.sleep(1.6),
}


def refuse(reply, given):
    reply.pop("result", None)
    reply["error"] = "RuntimeError: the simulator broke"
    given.clear()


def scaled(factor):
    def change(reply, given):
        given["depth"] = (given["depth"] * factor).astype("<f4")

    return change


def put(name, make):
    def change(reply, given):
        given[name] = make(given[name])

    return change


def moved(index, by):
    def change(reply, given):
        reply["result"]["state"][index] += by

    return change


def poked(value):
    def make(depth):
        depth[10:20] = value
        return depth

    return make


def elsewhere(T):
    T[0, 3] += 0.4
    return T


def turned(T):
    T[:3, :3] = T[:3, :3] @ np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [0.0, 0.0, -1.0]])
    return T


CHANGES = {
    "raises": refuse,
    "other version": lambda reply, given: reply.update(protocol=2),
    "no version": lambda reply, given: reply.pop("protocol"),
    "old answer": lambda reply, given: reply.update(sequence=reply["sequence"] - 1),
    "no sequence": lambda reply, given: reply.pop("sequence"),
    "no result": lambda reply, given: reply.update(result=None),
    "small picture": put("rgb", lambda rgb: rgb[::2, ::2]),
    "wide picture": put("rgb", lambda rgb: rgb.transpose(1, 0, 2)),
    "four channels": put("rgb", lambda rgb: np.dstack([rgb, rgb[..., :1]])),
    "float picture": put("rgb", lambda rgb: (rgb / 255.0).astype("<f4")),
    "black picture": put("rgb", np.zeros_like),
    "no picture": lambda reply, given: given.pop("rgb"),
    "no depth": lambda reply, given: given.pop("depth"),
    "small depth": put("depth", lambda depth: depth[1:]),
    "double depth": put("depth", lambda depth: depth.astype("<f8")),
    "millimetres": scaled(1000.0),
    "feet": scaled(3.281),
    "tenths": scaled(0.1),
    "negative depth": scaled(-1.0),
    "NaN depth": put("depth", poked(np.nan)),
    "zero depth": put("depth", poked(0.0)),
    "all infinite": put("depth", lambda depth: np.full_like(depth, np.inf)),
    "from elsewhere": put("T_world_from_camera", elsewhere),
    "turned over": put("T_world_from_camera", turned),
    "no pose": lambda reply, given: given.pop("T_world_from_camera"),
    "jumps": moved(0, 7.0),
    "spins": moved(2, 2.5),
    "NaN state": moved(1, float("nan")),
    "text state": lambda reply, given: reply["result"].update(state="here"),
    "short state": lambda reply, given: reply["result"]["state"].pop(),
    "no blocked": lambda reply, given: reply["result"].pop("blocked"),
    "not put down": moved(0, 0.01),
    "rolls": moved(3, 1.0),
}


def frames(server, header, arrays):
    listed = [[name, each.dtype.str, list(each.shape)] for name, each in arrays.items()]
    head = json.dumps({**header, "arrays": listed}).encode()
    return head, [np.ascontiguousarray(each).tobytes() for each in arrays.values()]


def garbage(server, header, arrays):
    server._socket.send(os.urandom(1000))


def garbage_frames(server, header, arrays):
    server._socket.send_multipart([os.urandom(50) for _ in range(4)])


def empty(server, header, arrays):
    server._socket.send(b"")


def a_list(server, header, arrays):
    server._socket.send(b"[1, 2]")


def cut(server, header, arrays):
    head, rest = frames(server, header, arrays)
    server._socket.send_multipart([head, *(each[:-3] for each in rest)] if rest else [head[:-5]])


def missing(server, header, arrays):
    head, rest = frames(server, {**header}, {**arrays, "more": np.zeros(3)})
    server._socket.send_multipart([head, *rest[:-1]])


def extra(server, header, arrays):
    head, rest = frames(server, header, arrays)
    server._socket.send_multipart([head, *rest, b"more"])


def huge_shape(server, header, arrays):
    head = json.dumps({**header, "arrays": [["rgb", "|u1", [2**40, 2**40]]]}).encode()
    server._socket.send_multipart([head, b"x"])


def objects(server, header, arrays):
    head = json.dumps({**header, "arrays": [["rgb", "|O", [1]]]}).encode()
    server._socket.send_multipart([head, b"12345678"])


def too_large(server, header, arrays):
    server._socket.send_multipart([b"{}", b"x" * (80 * 2**20)])


SENT = {
    "garbage": garbage,
    "garbage frames": garbage_frames,
    "empty": empty,
    "a list": a_list,
    "cut": cut,
    "missing frame": missing,
    "extra frame": extra,
    "huge shape": huge_shape,
    "objects": objects,
    "too large": too_large,
}

if __name__ == "__main__":
    serve.main(Faulty)
