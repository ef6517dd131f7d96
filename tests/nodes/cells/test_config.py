"""Variants of an experiment: what its cells are, where they run, and what is refused."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from nodes.cli.main import app
from nodes.experiment.plan.cell import select
from nodes.experiment.plan.experiment_file import read_experiment_file
from nodes.experiment.run.run import _refuse_two_in_one_folder
from nodes.experiment.show.given import given_in
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

ROOT = Path(__file__).parents[3]
JUNCTION, ROOM = (ROOT / "launch" / f"{name}.experiment.yaml" for name in ("junction", "room"))
FILE = f"""base: {JUNCTION}
setting: full
name: mine
over:
  variant:
    near:
      over.path: [straight]
      run_folder: runs/near
      world.car.turn_rate_lag_s: 0.5
    places: {{space.kind: places, over.seed: [7]}}
    room: {{base: {ROOM}, setting: panel, deploy.car: ideal, policy: {{naive_steps: 9, own_car: false}}}}
  victim: [hardened, naive]
  method: [none, gradient]
  seed: [0, 1]
contrasts:
  - {{name: far, before: near, after: room}}
"""


@pytest.fixture
def file(tmp_path):
    path = tmp_path / "mine.experiment.yaml"
    path.write_text(FILE)
    return path


def load(file, *overrides, folder=None):
    return load_experiment(file, None, list(overrides), folder)


def test_what_a_file_says_goes_before_every_setting_of_its_base(tmp_path):
    """A base's own entry of a setting is laid over the base; the file's values over both, and its own entry over these."""
    (tmp_path / "base.experiment.yaml").write_text(
        "name: base\nattack: {evaluations: 1, starts: 1}\nsettings:\n  demo: {attack: {evaluations: 2, starts: 2}, held_cap_m: 2}\n  full: {}\n"
    )
    mine = tmp_path / "mine.experiment.yaml"
    mine.write_text(
        "base: base.experiment.yaml\nname: mine\nattack: {evaluations: 50}\nsettings:\n  full: {attack: {starts: 5}}\n"
    )
    third = tmp_path / "third.experiment.yaml"
    third.write_text("base: mine.experiment.yaml\nheld_cap_m: 3\n")
    read = {
        (file, setting): read_experiment_file(file, setting, []).document.data
        for file in (mine, third)
        for setting in (None, "full")
    }
    assert read[mine, None] == {"name": "mine", "attack": {"evaluations": 50, "starts": 2}, "held_cap_m": 2}
    assert read[mine, "full"] == {"name": "mine", "attack": {"evaluations": 50, "starts": 5}}
    assert read[third, None] == read[mine, None] | {"held_cap_m": 3}
    assert read[third, "full"] == read[mine, "full"] | {"held_cap_m": 3}
    assert read_experiment_file(third, None, []).of == "mine"


def test_files_that_a_base_names_lie_beside_the_base(tmp_path):
    """A user's file in another folder than its base looked for them beside itself, and took others of the same name there."""
    there = tmp_path / "launch"
    there.mkdir()
    for name in ("mine.py", "room.reference.yaml", "policy.onnx", "level"):
        (there / name).touch()
    (tmp_path / "policy.onnx").touch()
    (there / "base.experiment.yaml").write_text(
        "name: base\nreference: room.reference.yaml\nworld: {kind: level}\nvictims: {a: {policy: policy.onnx}, b: {policy: 'made:of'}}\n"
        "settings:\n  demo: {over: {method: [gradient, 'mine.py:Method', absent.py:Method]}}\n"
    )
    (there / "above.experiment.yaml").write_text("base: base.experiment.yaml\nname: above\n")
    mine = tmp_path / "mine.experiment.yaml"
    for base in ("launch/base", "launch/above"):
        mine.write_text(
            f"base: {base}.experiment.yaml\nname: mine\nvictims: {{c: {{policy: policy.onnx}}}}\n"
        )
        assert read_experiment_file(mine, None, []).document.data == {
            "name": "mine",
            "reference": "launch/room.reference.yaml",
            "world": {"kind": "level"},  # a name, although a file is called so
            "victims": {
                "a": {"policy": "launch/policy.onnx"},
                "b": {"policy": "made:of"},
                "c": {"policy": "policy.onnx"},
            },
            "over": {"method": ["gradient", "launch/mine.py:Method", "absent.py:Method"]},
        }


def test_an_experiment_is_the_product_of_what_it_goes_over(file):
    loaded = load(file)
    names = [cell.name for cell in loaded.cells]
    assert len(names) == len(set(names)) == 2 * (1 + 2) + 3 * 2 * (1 + 1) + 2 * (1 + 2)
    assert names[:3] == ["near_hardened_none_0", "near_hardened_gradient_0", "near_hardened_gradient_1"]
    places = [cell for cell in loaded.cells if cell.variant == "places"]
    assert {cell.scenario for cell in places} == {"straight_places", "right_places", "left_places"}
    assert {cell.path for cell in places} == {"straight", "right", "left"}
    assert {cell.seed for cell in places if cell.searched} == {7}
    near, room = (next(cell for cell in loaded.cells if cell.variant == name) for name in ("near", "room"))
    assert loaded.of(near).config.world["car"] == {"turn_rate_lag_s": 0.5}
    assert loaded.of(near) is loaded.of(near)
    assert loaded.folder_of(near) == Path("runs/near").resolve() == loaded.of(near).folder
    assert loaded.folder == Path("runs/mine").resolve() == loaded.folder_of(room)
    there = loaded.of(room).config
    assert (there.name, there.world["kind"], there.deploy.car, there.attack.starts) == (
        "room",
        "lab",
        "ideal",
        3,
    )
    assert loaded.of(near).config.name == "junction"  # whose run folders its variants can have
    assert load(file, folder=Path("elsewhere")).folder_of(room) == Path("elsewhere").resolve()


def test_any_key_is_an_axis_and_variants_are_named_by_its_values(file):
    axes = (
        "over.variant={}",
        "over.attack.evaluations=[20,60]",
        "over.deploy.car=[ideal,own]",
        "contrasts=[]",
    )
    loaded = load(file, *axes, "over.path=[left]", "over.seed=[3]")
    assert [*loaded.variants] == [
        f"evaluations-{count}_car-{car}" for count in (20, 60) for car in ("ideal", "own")
    ]
    configs = [
        loaded.of(cell).config for cell in loaded.cells if cell.method == "none" and cell.victim == "naive"
    ]
    assert [(each.attack.evaluations, each.deploy.car) for each in configs] == [
        (20, "ideal"),
        (20, "own"),
        (60, "ideal"),
        (60, "own"),
    ]
    assert loaded.cells[1].name == "evaluations-20_car-ideal_hardened_gradient_3"
    paths = {cell.scenario for cell in load(file, *axes, "over.deploy.car=[own]").cells}
    assert "right_evaluations-20_car-own" in paths


def test_a_product_without_end_is_refused_before_it_is_read(file):
    many = [f"over.attack.{key}={list(range(1, 101))}" for key in ("evaluations", "starts", "time_batch")]
    with pytest.raises(ConfigError, match=r"at most 10000 variants, got 3000000; make several files"):
        load(file, *many)


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ("scenarios: [near, room, straight_places, elsewhere]", r"claims.0: .*elsewhere"),
        ("victims: [hardened, nobody]", r"claims.0: .*victim of near.*nobody"),
        ("method: gradeint", r"claims.0: .*method against hardened in near.*gradeint"),
        ("against: [nothing]", r"claims.0: .*nothing"),
        ("victims: [naive, naive]", "expected different ones, got naive, naive"),
        ("scenarios: [near, room]", "expected 4 scenarios or more, .*got 2 and 2"),
    ],
)
def test_a_claim_is_about_cells_that_are_there(file, change, told):
    claim = {
        "name": "places",
        "scenarios": "[near, straight_places, right_places, left_places]",
        "victims": "[hardened, naive]",
        "against": "[none]",
    }

    def said(values):
        return f"claims=[{{{', '.join(f'{key}: {value}' for key, value in values.items())}}}]"

    (found,) = load(file, said(claim)).config.claims
    assert found.scenarios == ("near", "straight_places", "right_places", "left_places")
    key, value = change.split(": ")
    with pytest.raises(ConfigError, match=told):
        load(file, said({**claim, key: value}))


@pytest.mark.parametrize(
    ("change", "told"),
    [
        (
            "over.victim=[hardened, hardend]",
            r"over.victim: expected a victim in near of hardened, .*; got 'hardend'",
        ),
        ("over.path=[straigt]", r"over.path: expected a path in near of straight, .*; got 'straigt'"),
        ("over.variant.near={over.path: [track]}", r"over.path: expected a path in near of .*; got 'track'"),
        (
            "over.variant.room.policy.naive_steps=0",
            r"over.victim: expected a victim in room of hardened; got 'naive'",
        ),
        ("measure.seed=-1", "measure.seed: .* greater than or equal to 0, got -1"),
        ("horizon=1e9", "horizon: .* less than or equal to 1000000, got 1000000000"),
        ("attack.evaluations=2000000", "attack.evaluations: .* less than or equal to 1000000, got 2000000$"),
        (f"measure.seed={10**30}", "measure.seed: .* less than or equal to 2147483647, got 10{30}$"),
        *(
            (
                f"victims={{mine: {text}}}",
                r"victims.mine: expected \{policy: FILE\} .* or \{train: \{\}\} .*, got",
            )
            for text in ("{}", "{polcy: a.onnx}", "a.onnx", "null")
        ),
    ],
)
def test_cells_are_of_victims_and_paths_that_exist(file, change, told):
    """They would be registered, and fail after hours of learning."""
    with pytest.raises(ConfigError, match=told):
        load(file, change)


def test_a_retrained_victim_exists_where_one_is_retrained(file):
    made = load_experiment(JUNCTION, "retrain", ["over.victim=[retrained]"], None)
    assert {cell.victim for cell in made.cells} == {"retrained"}
    with pytest.raises(ConfigError, match="expected a victim of hardened, naive; got 'retrained'"):
        load_experiment(JUNCTION, "full", ["over.victim=[retrained]"], None)


def test_overrides_hold_for_all_variants(file):
    loaded = load(file, "attack.evaluations=9", "over.seed=[4]")
    assert {each.attack.evaluations for each in loaded.variants.values()} == {9}
    assert {cell.seed for cell in loaded.cells if cell.searched} == {4}


def test_cells_are_selected_by_what_they_are(file):
    cells = load(file).cells
    chosen = select(cells, "variant=places,path=left+right,method=gradient,victim=naive")
    assert [cell.name for cell in chosen] == ["right_places_naive_gradient_7", "left_places_naive_gradient_7"]
    assert select(cells, "") == list(cells)
    with pytest.raises(
        ConfigError, match="expected KEY=VALUE with KEY one of variant, path, victim, method, seed"
    ):
        select(cells, "mode=random")
    with pytest.raises(ConfigError, match="expected some cells, got none"):
        select(cells, "variant=near,path=left")
    for only, told in (
        ("variant=monitor", "expected a variant of near, places, room; got 'monitor'"),
        ("variant=near,seed=0+9", "expected a seed of 0, 1, 7; got '9'"),
        ("method=gradient,method=none", r"expected method once, got it twice; join its values with \+"),
    ):
        with pytest.raises(ConfigError, match=told):
            select(cells, only)


@pytest.mark.parametrize(
    ("old", "new", "says"),
    [
        ("  seed: [0, 1]", "  seeds: [0, 1]", "over: expected variant, path, victim, method, seed, or keys of the experiment"),
        ("run_folder: runs/near", "run_folders: runs/near", r"mine.experiment.yaml:8: unknown key run_folders"),
        ("world.car.turn_rate_lag_s", "deploy.turn_rate_lag_s", r":9: unknown key deploy.turn_rate_lag_s"),
        ("[none, gradient]", "[none, gradiant]", r":13: over.method.1: expected an attack method .*\(did you mean gradient\?\)"),
        ("seed: [0, 1]", "seed: [0, 0]", "every one of over.seed once"),
        ("over.seed: [7]", "over.seed: [7, 7]", "every one of over.seed once"),
        ("  method: [none, gradient]", "  method: []", r":13: over.method: expected at least 1, got none"),
        ("room.experiment", "rom.experiment", r"rom.experiment.yaml: expected a file, found none"),
        ("setting: panel", "setting: pannel", "no setting called 'pannel'; known are demo, full"),
        (f"base: {JUNCTION}\n", "", r"mine.experiment.yaml:1: expected setting only with base"),
        ("    near:", "    Near!:", "Near!"),
        ("before: near", "before: nearer", r":16: contrasts.0: expected a variant of near, .*'nearer' \(did you mean near\?\)"),
        ("    places:", "    straight_places: {over.path: [straight]}\n    places:", "straight_places_hardened_none_0 2 times; rename"),
        ("  victim:", "  attack.starts: [1, 1]\n  victim:", "two variants of the name near_starts-1"),
        ("  victim:", "  attack.starts: 2\n  victim:", r":12: over.attack.starts: expected a list in brackets, got 2"),
    ],
)  # fmt: skip
def test_a_bad_file_is_told_with_its_line(file, old, new, says):
    assert old in FILE
    file.write_text(FILE.replace(old, new))
    with pytest.raises(ConfigError, match=says):
        load(file)


def test_two_variants_in_one_run_folder_need_the_same_scene_and_policies(tmp_path):
    """Or one would run on the policy of the other, under a hash that says otherwise."""
    folder, file = tmp_path / "run", tmp_path / "twice.experiment.yaml"

    def two(change):
        variants = f"{{variant: {{plain: {{}}, other: {{{change}}}}}, seed: [0]}}"
        file.write_text(f"base: {JUNCTION}\nsetting: full\nname: twice\nover: {variants}\n")
        return load(file, folder=folder)

    loaded = two("policy.seed: 1")
    with pytest.raises(
        ConfigError,
        match=r"plain and other to have the same settings of stage policy, as both are in .*run_folder of its own",
    ):
        _refuse_two_in_one_folder(loaded, select(loaded.cells, "variant=other"))
    assert not folder.exists()
    loaded = two("attack.evaluations: 7")
    _refuse_two_in_one_folder(loaded, loaded.cells)
    shipped = [
        each
        for each in sorted((ROOT / "launch").glob("*.experiment.yaml"))
        if "  variant:" in each.read_text()
    ]
    assert len(shipped) == 19
    for each in shipped:
        loaded = load(each)
        if given_in(loaded.config):
            # What its victims see is compared with the camera of a world that must be open.
            folders = {cell.variant: loaded.folder_of(cell) for cell in loaded.cells}
            assert len(set(folders.values())) == len(folders)
        else:
            _refuse_two_in_one_folder(loaded, loaded.cells)


def test_more_than_a_thousand_cells_ask(file):
    """Without a terminal the answer is an option."""
    asked = CliRunner().invoke(
        app, ["experiment", "run", str(file), "--set", f"over.seed={list(range(300))}"]
    )
    assert isinstance(asked.exception, ConfigError)
    assert "expected at most 1000 cells without --many, got 3010; add it" in str(asked.exception)


def test_a_page_of_some_cells_does_not_take_the_place_of_the_page_of_all(bench, monkeypatch, tmp_path):
    monkeypatch.syspath_prepend(str(bench.folder))

    def call(name, *options):
        done = CliRunner().invoke(app, ["experiment", name, str(bench.file), *options])
        assert done.exit_code == 0, done.output
        return done.output

    assert "of 3 cells; page: " in call("report")
    whole = (bench.cells.parent / "table" / "table.json").read_text()
    assert {row["method"] for row in json.loads(whole)["rows"]} == {"none", "gradient"}
    said = call("table", "--only", "method=gradient")
    assert said.count(" missing ") == 2  # in either domain
    assert "0 of 2 cells; advnerf experiment report writes a page of them" in said
    assert (bench.cells.parent / "table" / "table.json").read_text() == whole
    with pytest.raises(ConfigError, match="expected --output with --only"):
        CliRunner().invoke(
            app, ["experiment", "report", str(bench.file), "--only", "seed=0"], catch_exceptions=False
        )
    call("report", "--only", "method=gradient", "-o", str(tmp_path / "some"))
    assert {row["method"] for row in json.loads((tmp_path / "some" / "table.json").read_text())["rows"]} == {
        "gradient"
    }
