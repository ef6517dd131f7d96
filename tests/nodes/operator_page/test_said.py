"""Messages of a page: what is accepted, and that nothing else is."""

import json
import random

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from nodes.operator_page.client import Client, Misuse
from nodes.operator_page.pictures import Picture
from nodes.operator_page.said import Hold, Label, PictureSeen, read_said
from nodes.runtime.errors import MessageError

ACT = {"key": "0" * 32, "n": 1, "frame": "0"}


def test_what_a_page_says():
    assert read_said('{"t":"seen","c":1,"s":"1763900000000000000"}') == PictureSeen(
        t="seen", c=1, s="1763900000000000000"
    )
    assert isinstance(read_said(json.dumps({"t": "hold", "beat": 3, "press": 1, **ACT})), Hold)
    label = read_said(json.dumps({"t": "label", "text": "  a person crossed  ", **ACT}))
    assert isinstance(label, Label)
    assert label.text == "a person crossed"


@pytest.mark.parametrize(
    "text",
    [
        "",
        "null",
        "[]",
        "{",
        "1e999",
        '{"t":"hold"}',
        '{"t":"arm"}',
        '{"t":"seen","c":3,"s":"1"}',
        '{"t":"seen","c":0,"s":"-1"}',
        '{"t":"seen","c":0,"s":"1","more":1}',
        '{"t":"seen","c":"0","s":"1"}',
        json.dumps({"t": "hold", "beat": True, "press": 1, **ACT}),
        json.dumps({"t": "hold", "beat": 1.5, "press": 1, **ACT}),
        json.dumps({"t": "hold", "beat": 1, "press": 0, **ACT}),
        json.dumps({"t": "label", "text": "two\nlines", **ACT}),
        json.dumps({"t": "label", "text": " ", **ACT}),
        json.dumps({"t": "take", "name": "Ann\u202enna", **ACT}),
        json.dumps({"t": "take", "name": "x" * 41, **ACT}),
        json.dumps({"t": "label", "text": "x" * 201, **ACT}),
        json.dumps({"t": "attack", "id": "../../etc/pa", **ACT}),
        json.dumps({"t": "take", "name": "", **ACT}),
        json.dumps({"t": "trial", **ACT, "key": "0" * 31}),
        json.dumps({"t": "reset_estop"}),
        "[" * 2000,
        '{"t":"label","text":"' + "x" * 3000,
    ],
)
def test_malformed_messages_are_one_clear_error(text):
    with pytest.raises(MessageError, match="expected"):
        read_said(text)


@settings(max_examples=300)
@given(
    st.one_of(
        st.text(max_size=300),
        st.binary(max_size=300),
        st.recursive(
            st.none() | st.booleans() | st.floats() | st.text(),
            lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
        ).map(json.dumps),
    )
)
def test_anything_else_is_refused_too(data):
    with pytest.raises(MessageError):
        read_said(data)


class Nowhere:
    async def send_text(self, data):
        raise AssertionError

    async def send_bytes(self, data):
        raise AssertionError


@pytest.fixture
def client():
    return Client(1, "127.0.0.1", Nowhere())


def act(client, n, frame="0", key=None):
    return json.dumps({"t": "trial", "key": client.key if key is None else key, "n": n, "frame": frame})


def test_an_act_is_taken_once_and_only_with_the_key_of_its_connection(client):
    assert client.hear(act(client, 1)).act.n == 1
    assert client.hear(act(client, 1)) is None  # replayed
    assert client.hear(act(client, 0)) is None
    assert client.hear(act(client, 2, key=Client(2, "127.0.0.1", Nowhere()).key)) is None
    assert client.malformed == 3
    assert client.hear(act(client, 2)).act.n == 2


def test_an_act_names_a_picture_that_was_sent(client):
    assert client.hear(act(client, 1, frame="77")) is None
    client._sent[77] = 5  # as after a picture with this stamp
    asked = client.hear(act(client, 2, frame="77"))
    assert (asked.frame_ns, asked.picture_ns) == (77, 5)


@pytest.mark.parametrize("kind", ["estop", "disarm"])
@pytest.mark.parametrize(
    "more",
    [
        {},
        {"frame": "77"},  # not among the pictures that were sent
        {"frame": -3, "n": "x", "key": None},
        {"frame": "9" * 40, "n": 2**70, "more": [1]},
    ],
)
def test_a_stop_needs_no_key_number_or_picture(client, kind, more):
    client._last_n = 10**6
    asked = client.hear(json.dumps({"t": kind, **more}))
    assert (asked.act.t, asked.frame_ns, asked.picture_ns) == (kind, 0, 0)
    assert client.malformed == 0


@pytest.mark.parametrize("kind", ["estop", "disarm"])
def test_a_stop_names_the_picture_that_was_seen_if_there_was_one(client, kind):
    client._sent[77] = 5
    asked = client.hear(json.dumps({"t": kind, "frame": "77", "n": 4}))
    assert (asked.frame_ns, asked.picture_ns, asked.act.n) == (77, 5, 4)


def test_a_stop_is_heard_when_all_budgets_are_used_up(client):
    client._messages._left = client._acts._left = -1e9
    other = json.dumps({"t": "label", "key": client.key, "n": 1, "frame": "0", "text": "estop"})
    assert client.hear('{"t":"disarm"}').act.t == "disarm"
    with pytest.raises(Misuse):
        client.hear(other)
    for _ in range(30):
        client.hear('{"t":"disarm"}')
    assert client.hear('{"t":"estop"}').act.t == "estop"


def test_a_stranger_in_the_connection_is_thrown_out(client):
    for number in range(99):
        assert client.hear("x" * (number + 1)) is None
    with pytest.raises(Misuse, match="100 malformed messages"):
        client.hear("x")


def test_a_flood_is_thrown_out(client):
    def flood():
        for _ in range(2000):
            client.hear('{"t":"seen","c":0,"s":"1"}')

    with pytest.raises(Misuse, match="more than 120 messages a second"):
        flood()


def test_a_flood_of_acts_is_thrown_out(client):
    def flood():
        for number in range(60):
            client.hear(act(client, number))

    with pytest.raises(Misuse, match="more than 10 acts a second"):
        flood()


def test_only_the_newest_picture_waits(client):
    client.hear('{"t":"wants","c":[0]}')
    rng = random.Random(0)
    for stamp in range(1, 50):
        client.offer_picture(Picture(0, stamp, stamp, rng.randbytes(10)))
        client.offer_picture(Picture(1, stamp, stamp, rng.randbytes(10)))
    assert list(client._pictures) == [0]
    assert client._pictures[0].stamp_ns == 49
