import json
import time
from itertools import pairwise

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from advnerf_core.csv_rows import read_csv
from advnerf_core.documents import (
    dump_yaml,
    parse_json,
    parse_yaml,
    raise_problems,
    read_json,
    read_text,
    read_yaml,
)
from advnerf_core.errors import ConfigError

BOM = b"\xef\xbb\xbf"


@pytest.mark.parametrize(
    ("text", "value"),
    [
        # The examples of the core schema in the specification of YAML 1.2, section 10.3.2.
        *[(word, None) for word in ("null", "Null", "NULL", "~")],
        *[(word, True) for word in ("true", "True", "TRUE")],
        *[(word, False) for word in ("false", "False", "FALSE")],
        *[("0", 0), ("0o7", 7), ("0x3A", 58), ("-19", -19), ("+12", 12)],
        *[("0.", 0.0), ("-0.0", -0.0), (".5", 0.5), ("+12e03", 12000.0), ("-2E+05", -200000.0)],
        *[(".inf", float("inf")), ("-.Inf", -float("inf")), ("+.INF", float("inf")), ("1e0", 1.0)],
        # Numbers, booleans and dates of YAML 1.1 only.
        *[
            (word, word)
            for word in ("on", "Off", "yes", "No", "y", "3:14", "1_000", "0b11", "2026-11-25", "=")
        ],
        *[("'010'", "010"), ('"true"', "true"), ("!!str 3", "3"), ("! 3", "3"), ("!!float 3", 3.0)],
    ],
)
def test_a_value_is_that_of_the_core_schema(text, value):
    found = parse_yaml(f"key: {text}", "a.yaml").data["key"]
    assert (type(found), found) == (type(value), value)


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ("a: 1\nb: 2\na: 3\n", ["a.yaml:3: a is given twice; remove one of them"]),
        ("{a: {b: 1, b: 2}}", ["a.yaml:1: a.b is given twice; remove one of them"]),
        ("1: a\n0x1: b\n", ["a.yaml:2: 1 is given twice; remove one of them"]),
        ("seeds: [010]", ["a.yaml:1: 010: expected a number without leading zeros"]),
        ("a: 1\na: 2\nb: -08\n", ["a.yaml:2: a is given twice", "a.yaml:3: -08: expected a number without"]),
        ("a: &a {x: *a}", ["a.yaml:1: *a is part of the value that it refers to; remove the alias"]),
        ("a: &a [1]\nb: [*a, *c]", ["a.yaml:2: expected an anchor &c above *c, found none"]),
        ("a: 1\n---\nb: 1\n", ["a.yaml:2: expected valid YAML: one document"]),
        ("? [a]\n: 1\n", ["a.yaml:1: expected a plain key"]),
        ("a: !!int x\nb: !x 1\n", ["a.yaml:1: expected a value of the tag !!int", "a.yaml:2: expected valid YAML: remove"]),
        ("a: !!set {b}\n", ["a.yaml:1: expected valid YAML: remove the tag !!set"]),
        ("a: [b\n", ["a.yaml:1: expected valid YAML: "]),
        ("[" * 5000, ["a.yaml:1: expected at most 100 levels of nesting"]),
        ("a: " + "1" * 5000, ["a.yaml:1: expected a shorter number, got 5000 digits"]),
        ("<<: 3\na: 1\n", ["a.yaml:1: <<: expected keys and values, got 3"]),
    ],
)  # fmt: skip
def test_every_mistake_of_a_yaml_text_has_its_line(text, lines):
    with pytest.raises(ConfigError) as caught:
        parse_yaml(text, "a.yaml")
    found = str(caught.value).split("\n  ")
    assert len(found) == len(lines)
    assert all(line.startswith(start) for line, start in zip(found, lines, strict=True)), found


def test_many_mistakes_are_listed_and_the_rest_is_counted():
    names = [chr(97 + i % 26) * (1 + i // 26) for i in range(50)]
    with pytest.raises(ConfigError) as caught:
        parse_yaml("".join(f"{name}: 1\n{name}: 1\n" for name in names), "a.yaml")
    lines = str(caught.value).split("\n  ")
    assert (lines[0][:9], lines[19][:10], lines[20:]) == ("a.yaml:2:", "a.yaml:40:", ["and 30 more problems"])


def test_a_mistake_in_many_rows_is_said_once_and_counted():
    rows = [f"a.csv:{i}: steering: expected a number, got 'nan'; correct the row" for i in range(2, 98)]
    with pytest.raises(ConfigError) as caught:
        raise_problems([*rows, "a.csv:99: expected 3 fields, got 2"])
    assert str(caught.value).split("\n  ") == [
        f"{rows[0]}; and 95 more like it",
        "a.csv:99: expected 3 fields, got 2",
    ]


def test_aliases_that_explode_are_refused_at_once():
    levels = "abcdefghi"
    text = "a: &a [0, 0, 0, 0, 0, 0, 0, 0, 0, 0]\n"
    text += "".join(f"{b}: &{b} [{', '.join([f'*{a}'] * 10)}]\n" for a, b in pairwise(levels))
    began = time.process_time()
    with pytest.raises(ConfigError, match="repeat at most 100000 values"):
        parse_yaml(text, "a.yaml")
    assert time.process_time() - began < 30.0


def test_an_alias_is_a_copy_and_merged_keys_give_way():
    data = parse_yaml("a: &a {x: 1, y: 2}\nb: *a\nc: {<<: [*a, {y: 5, z: 6}], x: 9}\n", "a.yaml").data
    data["b"]["x"] = 7
    assert data == {"a": {"x": 1, "y": 2}, "b": {"x": 7, "y": 2}, "c": {"x": 9, "y": 2, "z": 6}}


def test_places_name_the_lines_of_keys_and_values():
    document = parse_yaml("a:\n  b: [1,\n   2]\nc: 3\n", "a.yaml")
    assert [document.place(key) for key in ((), ("a",), ("a", "b"), ("a", "b", 1), ("c",), ("a", "x"))] == [
        "a.yaml:1", "a.yaml:1", "a.yaml:2", "a.yaml:3", "a.yaml:4", "a.yaml:1",
    ]  # fmt: skip


plain = (
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(st.characters(codec="utf-8", exclude_categories=("Cc", "Cs")), max_size=12)
)
numberlike = st.text("0123456789+-.eExo_:infNaN", max_size=8)


@settings(max_examples=200)
@given(
    st.recursive(
        plain | numberlike,
        lambda each: st.lists(each, max_size=4) | st.dictionaries(numberlike, each, max_size=4),
    )
)
def test_what_is_written_is_read_again(data):
    document = {"data": data}
    assert parse_yaml(dump_yaml(document), "a.yaml").data == document


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ('{"a": 1,\n "b": {"a": 2},\n "a": 3}', r"^a\.json:3: a is given twice; remove one of them$"),
        (
            '{"f": [{"k": 1,\n"k": 2}],\n"f": "f", "g": "f: {"}',
            r"^a\.json:2: k is .*\n  a\.json:3: f is given twice",
        ),
        ('{"\\u0061": 1, "a": 2}', "a is given twice"),
        ('{\n"a" 1}', r"^a\.json:2: expected valid JSON: .*column 5$"),
        ("[" * 100_000, "expected valid JSON"),
    ],
)
def test_every_mistake_of_a_json_text_has_its_line(text, message):
    with pytest.raises(ConfigError, match=message):
        parse_json(text, "a.json")


def test_a_byte_order_mark_is_no_part_of_a_file(tmp_path):
    for name, text in (("a.yaml", "a: 1"), ("a.json", '{"a": 1}'), ("a.csv", "a\n1\n")):
        (tmp_path / name).write_bytes(BOM + text.encode())
    assert read_yaml(tmp_path / "a.yaml").data == read_json(tmp_path / "a.json") == {"a": 1}
    assert [row.number("a") for row in read_csv(tmp_path / "a.csv", ["a"])] == [1.0]


def test_files_that_cannot_be_read_are_also_the_errors_of_the_system(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"none\.json: expected a file, found none"):
        read_json(tmp_path / "none.json")
    with pytest.raises(OSError, match="expected a readable file"):
        read_yaml(tmp_path)
    (tmp_path / "latin").write_bytes("a\nb: \xe9".encode("latin-1"))
    with pytest.raises(
        ConfigError, match=r"latin:2: expected UTF-8, got the byte 0xe9; save the file as UTF-8"
    ):
        read_text(tmp_path / "latin")
    (tmp_path / "wide").write_bytes("a: 1".encode("utf-16"))
    with pytest.raises(ConfigError, match="expected UTF-8, got UTF-16"):
        read_text(tmp_path / "wide")


def written(tmp_path, text):
    (tmp_path / "log.csv").write_text(text)
    return tmp_path / "log.csv"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a,b\n1,0,2\n3,4\n5\n", r"log\.csv:2: expected 2 fields .* got 3.*\n.*log\.csv:4: expected 2 fields .* got 1"),
        ("a,b,a\n1,2,3\n", r"log\.csv:1: the column a is given twice"),
        ("a;b\n1;2\n", r"log\.csv:1: expected columns a, b, got a;b; separate the columns by commas"),
        ("a;b\n1;0,2\n3;0,4\n", r"^[^\n]*:1: [^\n]*; separate the columns by commas, and write numbers with a decimal point$"),
        ("a\tb\n1\t0,2\n", r":1: .*; separate the columns by commas"),
        ("a,c\n1,2\n", r"log\.csv:1: expected columns a, b, got a, c; correct the header"),
        ("# my drive\na,b\n1,2\n3,4\n", r"^[^\n]*log\.csv:1: expected columns a, b, got # my drive; correct the header$"),
        ("", "got an empty file"),
        ('a,b\n1,2\n1,"2\n3,4\n', r"log\.csv:3: expected valid CSV: .*; close each quote"),
        ('a,b\n"x,1\n"y,2\n', r"log\.csv:2: expected valid CSV: .*; close each quote"),
    ],
)  # fmt: skip
def test_every_mistake_of_a_csv_file_has_its_line(tmp_path, text, message):
    with pytest.raises(ConfigError, match=message):
        read_csv(written(tmp_path, text), ["a", "b"])


def test_a_line_before_the_header_is_told_once(tmp_path):
    said = r"^[^\n]*log\.csv:1: expected a header of as many fields as the rows have, got # my drive; remove the lines before the header[^\n]*$"
    with pytest.raises(ConfigError, match=said):
        read_csv(written(tmp_path, "# my drive\n\na,b\n1,2\n3,4\n"))


def test_rows_have_numbers_and_their_place(tmp_path):
    first, second = read_csv(written(tmp_path, 'a,b\n1,-2.5e-1\n\n"x, y","0,5"\n'), ["a", "b"])
    assert (first.number("a"), first.number("b"), first.number("c", 7.0)) == (1.0, -0.25, 7.0)
    assert (second.values["a"], second.place) == ("x, y", f"{tmp_path / 'log.csv'}:4")
    with pytest.raises(ConfigError, match=r":4: b: expected a number, got '0,5'; write a decimal point"):
        second.number("b")
    for wrong in ("nan", "1_0", "", "three", "1e999"):
        with pytest.raises(ConfigError, match=r"expected a number, got .*; correct the row"):
            read_csv(written(tmp_path, f"a,b\n1,{wrong}\n"))[0].number("b")


def test_json_reads_what_the_library_reads(tmp_path):
    data = {"a": [1, 2.5, None, True, "é\n"], "b": {"a": {"b": []}}}
    (tmp_path / "a.json").write_text(json.dumps(data, indent=1))
    assert read_json(tmp_path / "a.json") == data
