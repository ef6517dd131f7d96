"""Which files are a bag, and in which order: ours and those of rosbag2, whole and with a part missing."""

from pathlib import Path

import pytest
import yaml

from nodes.bags.parts import bag_parts, part_name
from nodes.runtime.errors import BagError


def folder_with(tmp_path, *names, listed=None, folder="drive"):
    bag = tmp_path / folder
    bag.mkdir()
    for name in names:
        (bag / name).write_bytes(b"")
    if listed is not None:
        text = yaml.safe_dump({"rosbag2_bagfile_information": {"version": 9, "relative_file_paths": listed}})
        (bag / "metadata.yaml").write_text(text)
    return bag


def names(bag):
    return [path.name for path in bag_parts(bag)]


def test_parts_come_in_the_order_of_their_numbers_from_wherever_the_bag_is_named(tmp_path, monkeypatch):
    parts = [part_name("drive", number) for number in range(12)]
    bag = folder_with(tmp_path, *parts)
    assert names(bag) == names(bag / "drive_7.mcap") == parts  # 10 comes after 9
    monkeypatch.chdir(bag)
    assert names(bag / "drive_7.mcap") == parts
    assert names(Path("drive_7.mcap")) == names(Path()) == parts


def test_metadata_gives_the_order_and_old_versions_wrote_the_folder_before_the_name(tmp_path):
    bag = folder_with(tmp_path, "b.mcap", "a.mcap", listed=["drive/b.mcap", "a.mcap"])
    for given in (bag, bag / "metadata.yaml", bag / "a.mcap"):
        assert names(given) == ["b.mcap", "a.mcap"]


def test_parts_that_a_killed_recorder_did_not_list_follow(tmp_path):
    bag = folder_with(
        tmp_path, *(part_name("drive", n) for n in range(3)), "stranger.mcap", listed=["drive_0.mcap"]
    )
    assert names(bag) == ["drive_0.mcap", "drive_1.mcap", "drive_2.mcap"]
    assert names(bag / "drive_2.mcap") == names(bag)
    assert names(bag / "stranger.mcap") == ["stranger.mcap"]


@pytest.mark.parametrize(
    ("files", "listed", "missing"),
    [
        (
            ["drive_0.mcap", "drive_2.mcap"],
            None,
            "drive_1.mcap of the bag is missing, but a later one exists",
        ),
        (
            ["drive_1.mcap", "drive_2.mcap"],
            None,
            "drive_0.mcap of the bag is missing, but a later one exists",
        ),
        (["drive_1.mcap"], None, "drive_0.mcap of the bag is missing, but a later one exists"),
        (
            ["drive_0.mcap"],
            ["drive_0.mcap", "drive_1.mcap"],
            r"drive_1.mcap of the bag is missing, but metadata.yaml",
        ),
        (
            ["drive_0.mcap", "drive_2.mcap"],
            ["drive_0.mcap"],
            "drive_1.mcap of the bag is missing, but a later one",
        ),
    ],
)
def test_a_missing_part_is_named_in_one_line(tmp_path, files, listed, missing):
    bag = folder_with(tmp_path, *files, listed=listed)
    for given in (bag, bag / files[-1]):
        with pytest.raises(BagError, match=missing) as raised:
            bag_parts(given)
        assert "\n" not in str(raised.value)


def test_numbered_files_of_a_folder_with_another_name_are_bags_by_themselves(tmp_path):
    bag = folder_with(
        tmp_path, "take_1.mcap", "take_2.mcap", "corner.mcap", "corner.golden.mcap", folder="clips"
    )
    for name in ("take_1.mcap", "take_2.mcap", "corner.mcap", "corner.golden.mcap"):
        assert names(bag / name) == [name]
    with pytest.raises(
        BagError, match=r"with the parts NAME_0\.mcap, NAME_1\.mcap \.\.\., got 4: corner\.golden\.mcap, "
    ):
        bag_parts(bag)


def test_sqlite_files_are_parts_too(tmp_path):
    listed = folder_with(tmp_path, "x_0.db3", "x_1.db3", listed=["x_0.db3", "x_1.db3"], folder="listed")
    counted = folder_with(tmp_path, "x_0.db3", "x_1.db3", folder="x")
    assert names(listed) == names(counted) == ["x_0.db3", "x_1.db3"]


def test_hidden_files_and_single_files_without_a_number(tmp_path):
    bag = folder_with(tmp_path, "bag.mcap", ".bag.mcap", ".bag.mcap.journal")
    assert names(bag) == ["bag.mcap"]
    with pytest.raises(BagError, match=r"expected a bag folder with \.mcap, \.db3 or \.bag files"):
        bag_parts(tmp_path / "nothing")
    with pytest.raises(BagError, match=r"expected a bag folder with \.mcap, \.db3 or \.bag files"):
        bag_parts(folder_with(tmp_path, folder="empty"))


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"a: [",
        b"\xff\xfe\x00",
        b"[" * 5000,
        b"rosbag2_bagfile_information: 3",
        b"rosbag2_bagfile_information: {relative_file_paths: ['']}",
        b"rosbag2_bagfile_information: {relative_file_paths: [3]}",
    ],
)
def test_metadata_that_makes_no_sense_is_one_line(tmp_path, content):
    bag = folder_with(tmp_path, "drive_0.mcap")
    (bag / "metadata.yaml").write_bytes(content)
    with pytest.raises(
        BagError, match=r"metadata\.yaml: expected .*; remove it to read the parts by their"
    ) as raised:
        bag_parts(bag)
    assert "\n" not in str(raised.value)
