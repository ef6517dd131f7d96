"""The wire of rmw_zenoh against the examples of its documentation, and against Zenoh's own serialisation."""

import pytest

from nodes.linking.ros2.publishers import Publishers
from nodes.linking.ros2.rmw_zenoh import (
    Attachment,
    endpoint_token,
    gid_of,
    node_token,
    parse_token,
    tokens_of,
    topic_key,
)
from nodes.linking.ros2.routes import Endpoint
from nodes.runtime.errors import MessageError
from nodes.runtime.messages import type_hash

STRING_HASH = "RIHS01_df668c740482bbd48fb39d76a70dfd4bd59db1288021743503259e948f6b1a18"
LISTENER, TALKER = "aac3178e146ba6f1fc6e6a4085e77f21", "8b20917502ee955ac4476e0266340d5c"
CHATTER = Endpoint("/chatter", "std_msgs/msg/String", True, 10)
TWIST = Endpoint("/cmd_vel", "geometry_msgs/msg/TwistStamped", True, 10)
S = 10**9


def test_keys_and_tokens_are_those_of_the_documentation():
    # docs/design.md of ros2/rmw_zenoh
    assert topic_key(0, CHATTER) == f"0/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    robot = Endpoint("/robot1/chatter", "std_msgs/msg/String", True, 10)
    assert topic_key(0, robot) == f"0/robot1/chatter/std_msgs::msg::dds_::String_/{STRING_HASH}"
    assert node_token(2, LISTENER, "listener") == f"@ros2_lv/2/{LISTENER}/0/0/NN/%/%/listener"
    assert endpoint_token(2, LISTENER, 10, "MS", "listener", CHATTER) == (
        f"@ros2_lv/2/{LISTENER}/0/10/MS/%/%/listener/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,10:,:,:,,"
    )
    seven = Endpoint("/chatter", "std_msgs/msg/String", True, 7)
    assert endpoint_token(2, TALKER, 10, "MP", "talker", seven) == (
        f"@ros2_lv/2/{TALKER}/0/10/MP/%/%/talker/%chatter/std_msgs::msg::dds_::String_/{STRING_HASH}/::,7:,:,:,,"
    )
    # rmw_qos_reliability_policy_e: best effort is 2
    lossy = Endpoint("/a/b", "std_msgs/msg/String", False, 5)
    assert endpoint_token(0, TALKER, 11, "MP", "n", lossy).endswith(
        "/%a%b/std_msgs::msg::dds_::String_/" + STRING_HASH + "/2::,5:,:,:,,"
    )


@pytest.mark.parametrize(
    ("typename", "stated"),
    [
        # As `ros2 topic info -v` prints them. They are the same from Iron to Lyrical.
        ("std_msgs/msg/String", STRING_HASH),
        ("sensor_msgs/msg/Image", "RIHS01_d31d41a9a4c4bc8eae9be757b0beed306564f7526c88ea6a4588fb9582527d47"),
        (
            "sensor_msgs/msg/CompressedImage",
            "RIHS01_15640771531571185e2efc8a100baf923961a4d15d5569652e6cb6691e8e371a",
        ),
        (
            "sensor_msgs/msg/CameraInfo",
            "RIHS01_b3dfd68ff46c9d56c80fd3bd4ed22c7a4ddce8c8348f2f59c299e73118e7e275",
        ),
        (
            "geometry_msgs/msg/TwistStamped",
            "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
        ),
        (
            "geometry_msgs/msg/PoseStamped",
            "RIHS01_10f3786d7d40fd2b54367835614bff85d4ad3b5dab62bf8bca0cc232d73b4cd8",
        ),
        ("nav_msgs/msg/Odometry", "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0"),
        ("tf2_msgs/msg/TFMessage", "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087"),
        (
            "diagnostic_msgs/msg/DiagnosticArray",
            "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
        ),
        (
            "ackermann_msgs/msg/AckermannDriveStamped",
            "RIHS01_48ca7612a08d3bb72744fd98b71b7cf2ea24c6ad50fa4e1aa0bbad963c90d8cf",
        ),
    ],
)
def test_hashes_are_those_of_the_distributions(typename, stated):
    assert type_hash(typename) == stated


def test_an_attachment_is_what_the_serialisation_of_zenoh_makes_of_it():
    gid = bytes(range(1, 17))
    attachment = Attachment(5, 1_795_000_000 * S + 7, gid)
    # Two 64-bit numbers, the least significant byte first; then the length of the identity, and the identity.
    golden = "0500000000000000" + "0780d35bfd1ee918" + "10" + gid.hex()
    assert attachment.encode().hex() == golden
    assert Attachment.decode(bytes.fromhex(golden)) == attachment
    ext = pytest.importorskip("zenoh.ext")
    numbers = ext.Int64(5), ext.Int64(attachment.source_real_ns)
    assert ext.z_serialize((*numbers, gid)).to_bytes().hex() == golden


@pytest.mark.parametrize(
    "wrong",
    [
        b"",
        bytes(32),
        bytes(34),
        bytes(33),
        b"\x0fsequence_number" + bytes(8) + b"\x10source_timestamp" + bytes(8),
    ],
)
def test_other_attachments_are_refused(wrong):
    with pytest.raises(MessageError, match="expected an attachment of rmw_zenoh"):
        Attachment.decode(wrong)


def test_a_token_is_read_as_it_was_written():
    key = endpoint_token(2, TALKER, 10, "MP", "talker", CHATTER)
    token = parse_token(key)
    assert (token.kind, token.node) == ("MP", "/talker")
    assert (token.typename, token.type_hash) == ("std_msgs::msg::dds_::String_", STRING_HASH)
    assert parse_token(key.replace("/%/%/", "/%/%robot1%arm/")).node == "/robot1/arm/talker"
    assert parse_token(f"{key}/more").type_hash == STRING_HASH  # later versions may append to it
    for other in (
        node_token(2, TALKER, "talker"),
        "",
        "@ros2_lv",
        key.replace("MP", "SS"),
        key.replace("@ros2_lv", "x"),
    ):
        assert parse_token(other) is None


def test_the_tokens_of_a_topic_match_its_key_expression():
    zenoh = pytest.importorskip("zenoh")
    wanted = zenoh.KeyExpr(tokens_of(2, "/chatter"))
    assert wanted.includes(zenoh.KeyExpr(endpoint_token(2, TALKER, 10, "MP", "talker", CHATTER)))
    assert not wanted.includes(zenoh.KeyExpr(endpoint_token(3, TALKER, 10, "MP", "talker", CHATTER)))
    assert not wanted.includes(zenoh.KeyExpr(endpoint_token(2, TALKER, 10, "MP", "talker", TWIST)))


def tokens(count=1, endpoint=TWIST):
    return [
        parse_token(endpoint_token(0, f"{n + 1:032x}", 10, "MP", f"node{n}", endpoint)) for n in range(count)
    ]


def known(*announced):
    made = Publishers(TWIST)
    for token in announced:
        made.announce(token)
    return made


def test_a_publisher_of_rmw_zenoh_is_known_by_its_token():
    (one,) = tokens()
    publishers = known(one)
    writer = publishers.heard(one.gid, S)
    assert publishers.present(S) == (writer,)
    assert writer.startswith("/node0 ")
    publishers.withdraw(one.key)
    assert publishers.present(S) == ()


def test_any_other_identity_belongs_to_the_only_token():
    (one,) = tokens()
    publishers = known(one)
    writer = publishers.heard("aa", S)
    assert publishers.present(S) == (writer,)
    # A second identity is a second publisher, until it has been silent for a while.
    stranger = publishers.heard("bb", 2 * S)
    assert stranger not in (writer, "")
    assert publishers.present(2 * S) == (writer, stranger)
    assert publishers.heard("aa", 3 * S) == writer
    assert publishers.present(5 * S) == (writer,)


def test_a_stranger_that_was_first_is_counted_when_the_announced_one_speaks():
    (one,) = tokens()
    publishers = known(one)
    publishers.heard("bb", S)
    writer = publishers.heard(one.gid, S)
    assert len(publishers.present(S)) == 2
    assert publishers.heard("bb", S) != writer


def test_what_is_not_announced_never_counts_alone():
    publishers = known()
    assert publishers.heard("bb", S) not in publishers.present(S)
    assert publishers.present(S) == ()
    assert len(publishers.all(S)) == 1
    assert publishers.heard("", S) not in publishers.present(S)
    (one,) = tokens()
    publishers.announce(one)
    assert publishers.heard("", S).endswith("without identity")  # no attachment: never the announced one


@pytest.mark.parametrize("gid", ["aa", tokens()[0].gid])
def test_a_first_sample_may_come_before_its_token(gid):
    publishers = known()
    publishers.heard(gid, S)
    publishers.announce(*tokens())
    writer = publishers.heard(gid, S)
    assert publishers.present(S) == (writer,)


def test_a_late_sample_of_a_publisher_that_left_is_not_of_the_next():
    one, two = tokens(2)
    publishers = known(one)
    publishers.heard("aa", S)
    publishers.withdraw(one.key)
    publishers.announce(two)
    assert publishers.heard("aa", S) not in publishers.present(S)
    assert publishers.heard("bb", S) in publishers.present(S)
    assert len(publishers.present(S)) == 1


def test_a_flood_of_identities_is_bounded():
    publishers = known(*tokens())
    for n in range(10_000):
        publishers.heard(f"{n:032x}", S)
    assert 2 <= len(publishers.present(S)) <= 10


def test_two_tokens_are_two_publishers_and_our_own_is_none():
    one, two = tokens(2)
    assert len(known(one, two).present(S)) == 2
    ours = Publishers(TWIST, one.key)
    ours.announce(one)
    assert ours.all(S) == ()
    ours.announce(two)
    assert len(ours.all(S)) == 1


def test_another_type_or_definition_is_named():
    image = Endpoint("/cmd_vel", "sensor_msgs/msg/Image", True, 10)
    publishers = known(*tokens(endpoint=image))
    assert "correct the route's 'type'" in publishers.mismatch()
    assert publishers.present(S) == ()
    (one,) = tokens()
    humble = parse_token(one.key.replace(one.type_hash, "TypeHashNotSupported"))
    assert "TypeHashNotSupported" in known(humble).mismatch()
    assert known(humble, one).mismatch() == ""


def test_an_identity_is_the_hash_of_the_token():
    # XXH3 of 128 bits, as `xxhsum -H2` prints it, with its bytes from the last to the first.
    assert gid_of("").hex() == bytes.fromhex("99aa06d3014798d86001c324468d497f")[::-1].hex()
