import shutil
from pathlib import Path

import pytest

from advnerf_core.scene.presets import FAST
from nodes.experiment.engine.stages import StageError
from nodes.experiment.plan.cell import Cell
from nodes.experiment.run.whole import run_experiment
from nodes.experiment.steps.pipeline import stages_of
from nodes.experiment.steps.run import load_experiment
from nodes.runtime.errors import ConfigError

ROOM = Path(__file__).parents[3] / "launch" / "room.experiment.yaml"


def room(tmp_path, setting="demo", *overrides):
    return load_experiment(ROOM, setting, overrides, tmp_path)


def test_settings_lie_over_the_file_and_the_command_line_over_both(tmp_path):
    assert room(tmp_path).config.attack.horizon == 40
    assert room(tmp_path, "full").config.seeds == (0, 1, 2)
    changed = room(tmp_path, "full", "attack.horizon=30", "world.car.speed_mps=0.6")
    assert (changed.searched_ticks, changed.car.speed_mps) == (30, 0.6)
    assert room(tmp_path, "full").searched_ticks == room(tmp_path, "full").config.horizon
    assert changed.config.carrier.resolution == 64


@pytest.mark.parametrize(
    ("overrides", "message"),
    [
        (["attack.evaluation=3"], r"unknown key attack\.evaluation; valid keys here: .*evaluations"),
        (["attack.horizon=0"], r"attack\.horizon.*greater than or equal to 1"),
        (
            ["attack.horizon=61"],
            r"^--set attack\.horizon=61: expected attack\.horizon to be at most horizon = 60 ticks, which are measured, got 61",
        ),
        (["carrier={kind: screen, display_model: sometimes}"], r"display_model.*valid boolean"),
        (["carrier.display_model=false"], r"unknown key .*display_model"),
        (
            ["carrier={kind: overlay, panel: monitor}"],
            r"expected carrier\.kind screen with the panel monitor",
        ),
        (["carrier={kind: screen, panel: board}"], r"expected carrier\.kind overlay with the panel board"),
        (["space={kind: places}"], r"space\.kind colours with carrier\.kind overlay"),
        (["over.method=[none,empty,gradient]"], r"set deploy\.empty_scene instead"),
        (["carrier.panel=door"], r"carrier\.panel: .*board, monitor.*door"),
        (["world.camera.widht=3"], r"unknown key camera\.widht"),
        (["capture.colour_pairs=0"], r"colour_pairs of at least 1.*world lab have colours of their own"),
        (["deploy.through=air"], r"deploy\.through"),
        (["attack"], "expected KEY=VALUE"),
    ],
)
def test_a_wrong_value_is_one_error_with_the_way_out(tmp_path, overrides, message):
    with pytest.raises(ConfigError, match=message):
        room(tmp_path, "demo", *overrides)


def test_a_check_of_several_keys_has_the_line_of_the_first_that_was_written(tmp_path):
    file = tmp_path / "mine.experiment.yaml"
    file.write_text(f"name: mine\nbase: {ROOM}\nsetting: demo\n\nattack:\n  starts: 1\n  horizon: 61\n")
    with pytest.raises(
        ConfigError, match=r"mine\.experiment\.yaml:7: expected attack\.horizon to be at most"
    ):
        load_experiment(file, None, [], None)


def test_an_unknown_setting_names_those_there_are(tmp_path):
    with pytest.raises(ConfigError, match="no setting called 'huge'; known are demo, full"):
        room(tmp_path, "huge")
    file = tmp_path / "mine.experiment.yaml"
    file.write_text("name: mine\nsettings: {quick: {}, long: {}}\n")
    with pytest.raises(
        ConfigError, match="expected one of the settings quick, long, got none; give --setting"
    ):
        load_experiment(file, None, [], None)


def test_an_error_names_the_line_of_the_file(tmp_path):
    file = tmp_path / "bad.experiment.yaml"
    file.write_text(
        "name: room\nworld: {kind: lab}\npaths: [track]\nsettings:\n  demo:\n    attack:\n      horizen: 3\n"
    )
    with pytest.raises(ConfigError, match=r"bad\.experiment\.yaml:7: unknown key attack\.horizen"):
        load_experiment(file, "demo", [], tmp_path)


def test_a_file_says_only_what_is_other_than_its_base(tmp_path):
    (tmp_path / "base.experiment.yaml").write_text(ROOM.read_text())
    file = tmp_path / "mine.experiment.yaml"
    file.write_text(
        "base: base.experiment.yaml\nname: mine\ncarrier: {kind: screen, resolution: 32}\nover: {seed: [4, 5]}\n"
        "settings:\n  demo: {attack: {evaluations: 3}}\n  quick: {scene: {steps: 5}}\n"
    )
    mine, base = load_experiment(file, "demo", [], tmp_path), room(tmp_path)
    assert (mine.config.name, mine.config.carrier.panel, mine.config.attack.evaluations) == (
        "mine",
        "monitor",
        3,
    )
    assert mine.config.seeds == (4, 5)  # the file's, which lie over the base and the base's setting
    assert (mine.config.carrier.resolution, mine.config.policy) == (32, base.config.policy)
    assert load_experiment(file, "quick", [], tmp_path).config.seeds == (4, 5)
    file.write_text(file.read_text() + "view:\n  crop_topp: 3\n")
    with pytest.raises(ConfigError, match=r"mine\.experiment\.yaml:9: unknown key view\.crop_topp"):
        load_experiment(file, "demo", [], tmp_path)
    # A section of another kind has other keys.
    file.write_text("base: base.experiment.yaml\ncarrier: {kind: composed}\ndeploy: {through: world}\n")
    assert load_experiment(file, "demo", [], tmp_path).config.carrier.training == "composed"
    for wrong, says in (
        ("mine.experiment.yaml", "a base other than the file itself"),
        ("no.yaml", "expected a file"),
    ):
        file.write_text(f"base: {wrong}\n")
        with pytest.raises(ConfigError, match=says):
            load_experiment(file, "demo", [], tmp_path)


def test_a_stage_depends_on_its_own_settings_and_on_no_others(tmp_path):
    def changed(override):
        before = {stage.name: stage.settings for stage in stages_of(room(tmp_path))}
        after = {stage.name: stage.settings for stage in stages_of(room(tmp_path, "demo", override))}
        assert list(before) == ["capture", "scene", "bake", "object", "policy"]
        return {name for name in before if before[name] != after[name]}

    assert changed("attack.evaluations=7") == changed("space.cells=4") == changed("deploy.laps=0") == set()
    assert changed("attack.random_sigma=4") == {"policy"}
    assert changed("scene.exposure=true") == changed("scene.decay=exponential") == {"scene"}
    assert changed("scene.learning_rate=0.01") == {"scene"}
    assert changed("scene.exposure=false") == changed("scene.decay=cosine") == set()
    scene = room(tmp_path).config.scene
    assert (scene.decay, scene.learning_rate) == (FAST.decay, FAST.learning_rate)  # as advnerf scene train
    # What a screen shows without an attack is photographed; an overlay is drawn later.
    assert changed("carrier.plain_rgb=[0.5, 0.5, 0.5]") == {"policy"}
    assert changed("carrier.resolution=32") == {"policy"}
    assert changed("held_cap_m=2") == set()
    assert changed("horizon=50") == {"bake"}


def test_laps_are_a_stage_where_they_are_asked_for(tmp_path):
    assert [stage.name for stage in stages_of(room(tmp_path, "full"))][-1] == "live"
    for nothing in ("deploy.through=world", "deploy={through: nodes, laps: 0}"):
        assert "live" not in [stage.name for stage in stages_of(room(tmp_path, "full", nothing))]


def test_every_seed_meets_every_condition_and_the_naive_victim_the_first(tmp_path):
    full = room(tmp_path, "full").cells
    assert Cell("track", "hardened", "gradient", 2) in full
    assert {cell.seed for cell in full if cell.victim == "naive"} == {0}
    assert len(full) == len({cell.name for cell in full}) == 3 * 2 + 1 + 3


def test_the_first_start_of_every_seed_is_the_nominal_one_where_a_file_says_so(tmp_path):
    def first(seed, *overrides):
        return room(tmp_path, "full", *overrides).start_states("track", seed)[0].tolist()

    nominal = [-1.1, -2.0, 0.0]
    assert first(0) == first(2) == first(0, "attack.nominal_start=false") == nominal
    assert first(2, "attack.nominal_start=false") != nominal


def test_a_changed_node_graph_is_driven_again(tmp_path):
    for name in (ROOM.name, "green_screen.launch.yaml"):
        shutil.copy(ROOM.parent / name, tmp_path / name)
    experiment = load_experiment(tmp_path / ROOM.name, "full", [], tmp_path / "run")
    before = {stage.name: stage.settings for stage in stages_of(experiment)}
    graph = tmp_path / "green_screen.launch.yaml"
    graph.write_text(graph.read_text().replace("timeout_ms: 250", "timeout_ms: 300"))
    after = {stage.name: stage.settings for stage in stages_of(experiment)}
    assert {name for name in before if before[name] != after[name]} == {"live"}


def test_an_unknown_last_stage_leaves_nothing_behind(tmp_path):
    experiment = load_experiment(ROOM, "demo", [], tmp_path / "run")
    with pytest.raises(StageError, match="got 'flight'"):
        run_experiment(experiment, "flight")
    assert not (tmp_path / "run").exists()
