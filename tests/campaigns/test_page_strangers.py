"""What can a stranger do to the operator's page? A minute and a half in full.

The page is served with TLS and a one-time code. One browser drives the twin. Strangers try wrong hosts and origins, wrong, used
and expired codes, a stolen cookie, acts of another connection, and 100 000 malformed messages. What counts: acts that the node
granted to a stranger, and whether the operator still drives and the page still answers.
"""

from __future__ import annotations

import asyncio
import json
import math
import random
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed, InvalidStatus
from websockets.typing import Origin

from tests.campaigns.campaign import Campaign
from tests.support.live.operator import LiveOperator
from tests.support.live.page_browser import door_of, live_page
from tests.support.live.page_client import Browser, request, unchecked

_CODE_S = 5.0
_TRIES, _WAIT = 10, 429
# The node closes a connection at its hundredth malformed message.
_EACH, _AT_ONCE = 100, 12
_WORDS = ("hold", "take", "estop", "disarm", "attack", "label", "record", "seen", "wants", "arm", "__proto__")


@pytest.mark.campaign
def test_no_stranger_gets_an_act_of_the_page(campaign: Campaign) -> None:
    with live_page("record=false", f"page.code_s={_CODE_S}", host="0.0.0.0") as operator:
        operator.bus.subscribe("/operator/act", queue=100_000)
        port = int(door_of(operator.run_dir)["url"].rstrip("/").rpartition(":")[2])
        ann = Browser(port, enter(operator, port), tls=True)
        assert ann.take() == ""
        tried = {**refused_doors(operator, port), **refused_acts(operator, port, ann)}
        sent = malformed(operator, port, campaign.size(2000, 100_000))
        if ann.state["estop"]:  # said by a stranger with a session, who may
            assert ann.do("reset_estop") == ""
        ann.hold()
        operator.wait_until(lambda: operator.armed, 5.0, "to arm")
        strange = strange_acts(operator.run_dir)
        still = ann.do("attack_off") == "" and request(port, tls=True)[0] == 200
        ann.close()
    kinds = ", ".join(f"{count} {name}" for name, count in tried.items())
    campaign.record("acts that strangers got from the operator page", strange, "acts", "0, and the page stays up", strange == 0 and still, f"{kinds}, {sent} malformed messages; the operator drove afterwards")  # fmt: skip
    assert (strange, still) == (0, True)


def enter(operator: LiveOperator, port: int) -> str:
    """The cookie that the current code gives. The file may still show a code that was just used, or has just expired."""
    for _ in range(_TRIES):
        status, headers, body = _enter(port, door_of(operator.run_dir)["code"])
        if status == 200:
            return str(headers["set-cookie"]).partition(";")[0]
        if status == _WAIT:
            time.sleep(json.loads(body)["wait_s"])
    raise AssertionError("no code opens")


def _enter(port: int, code: str, origin: str = "") -> Any:
    headers = {"Origin": origin or f"https://127.0.0.1:{port}"}
    return request(port, "/enter", headers, "POST", json.dumps({"code": code}), tls=True)


def _looked_at(port: int, code: str) -> int:
    """The answer to a code once it is looked at: whoever gave wrong ones has to wait before that."""
    while (answer := _enter(port, code))[0] == _WAIT:
        time.sleep(json.loads(answer[2])["wait_s"])
    return int(answer[0])


def refused_doors(operator: LiveOperator, port: int) -> dict[str, int]:
    """Try to get in. Returns how many of each kind were refused, and fails if one was not."""
    code = door_of(operator.run_dir)["code"]
    assert _enter(port, code, "https://evil.example")[0] == 403
    cookie = enter(operator, port)
    # Each wrong code doubles the time until the next is looked at.
    wrong = ["AAAAAAAA", code, *("".join(random.choices("ABCDEFGH23456789", k=8)) for _ in range(2))]
    assert [_looked_at(port, each) for each in wrong] == [403] * len(wrong)
    assert _looked_at(port, "") == 400
    old = door_of(operator.run_dir)["code"]
    time.sleep(_CODE_S + 1.5)
    assert _looked_at(port, old) == 403
    origins = ["https://evil.example", "null", f"http://127.0.0.1:{port}", f"https://127.0.0.1:{port + 1}"]
    for origin in origins:
        _refused_live(port, cookie, origin)
    for stolen in ("", cookie[:-1], "advnerf_page=x"):
        _refused_live(port, stolen, f"https://127.0.0.1:{port}")
    seen = request(port, "/session", {"Cookie": cookie}, tls=True, source=("127.0.0.9", 0))
    assert json.loads(seen[2])["open"] is False
    assert request(port, headers={"Host": "evil.example"}, tls=True)[0] == 421
    return {
        "wrong origins": len(origins) + 1,
        "wrong or used codes": len(wrong) + 1,
        "expired codes": 1,
        "wrong or stolen cookies": 4,
        "wrong hosts": 1,
    }


def _refused_live(port: int, cookie: str, origin: str) -> None:
    try:
        Browser(port, cookie, origin, tls=True).close()
    except InvalidStatus:
        return
    raise AssertionError(f"expected origin {origin!r} with cookie {cookie!r} to be refused")


def refused_acts(operator: LiveOperator, port: int, ann: Browser) -> dict[str, int]:
    """Replay acts of the operator in a connection of somebody who may watch."""
    eve = Browser(port, enter(operator, port), tls=True)
    # Not the stops: whoever may watch may stop the car.
    acts: dict[str, dict[str, Any]] = {
        "hold": {"beat": 1, "press": 1},
        "release": {"press": 1},
        "label": {"text": "mine"},
        "record": {},
        "attack_off": {},
    }
    for number, (act, more) in enumerate(acts.items()):
        eve.tell({"t": act, "key": ann.welcome["key"], "n": 1000 + number, "frame": ann.frame, **more})
    eve.wait(lambda: sum(answer["t"] == "refused" for answer in eve.answers) == len(acts), "refusals")
    eve.close()
    return {"replayed acts": len(acts)}


def malformed(operator: LiveOperator, port: int, count: int) -> int:
    """Send messages that no page sends, in as many connections as it takes. Returns how many were sent."""
    cookie = enter(operator, port)
    with ThreadPoolExecutor(_AT_ONCE) as pool:
        sent = pool.map(
            lambda seed: asyncio.run(_pester(port, cookie, seed)), range(math.ceil(count / _EACH))
        )
        return sum(sent)


async def _pester(port: int, cookie: str, seed: int) -> int:
    """Send nonsense until the node closes the connection. Returns how many messages were sent."""
    rng, sent = random.Random(seed), 0
    while sent < _EACH:
        try:
            async with connect(
                f"wss://127.0.0.1:{port}/live",
                origin=Origin(f"https://127.0.0.1:{port}"),
                additional_headers={"Cookie": cookie},
                ssl=unchecked(),
                compression=None,
                close_timeout=0.2,
            ) as socket:
                while sent < _EACH:
                    await socket.send(_nonsense(rng))
                    sent += 1
        except (ConnectionClosed, InvalidStatus, OSError, TimeoutError):
            continue  # thrown out, as it should be, or not let in while others are
    return sent


def _nonsense(rng: random.Random) -> str | bytes:
    kind = rng.randrange(5)
    if kind == 0:
        return rng.randbytes(rng.randrange(1, 400))
    if kind == 1:
        return "".join(chr(rng.randrange(32, 0x2FFF)) for _ in range(rng.randrange(1, 200)))
    if kind == 2:
        return "[" * rng.randrange(1, 2000)
    act = {
        "t": rng.choice(_WORDS),
        "key": "0" * 32,
        "n": rng.randrange(-5, 10**6),
        "frame": "0",
        "press": 1,
        "beat": 1,
    }
    if kind == 3:
        act.pop(rng.choice(list(act)))
        act[rng.choice(("t", "key", "n", "x"))] = rng.choice((None, [], {}, 1e308, "x" * 300))
    return json.dumps(act)


def strange_acts(run_dir: Path) -> int:
    """Acts in the log that were granted to somebody else than Ann, but for stops."""
    rows = [json.loads(line) for line in (run_dir / "page" / "acts.jsonl").read_text().splitlines()]
    return sum(
        row["refused"] == "" and row["operator"] != "Ann" and row["act"] not in ("estop", "disarm")
        for row in rows
    )
