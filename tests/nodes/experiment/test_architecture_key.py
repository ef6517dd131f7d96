"""The architecture of a victim in experiment files, and in the key of its training."""

from pathlib import Path

import pytest

from advnerf_core.documents import parse_yaml
from advnerf_core.strict import validate
from nodes.experiment.plan.sections import PolicyConfig
from nodes.runtime.errors import ConfigError

EXAMPLES = Path(__file__).parents[3] / "examples"


def policy(text: str, folder: Path = EXAMPLES) -> PolicyConfig:
    return validate(PolicyConfig, parse_yaml(text, "a.yaml"), folder)


def test_the_default_is_not_in_the_key():
    key = policy("hidden: [16, 8, 4]").recipe
    assert key["hidden"] == [16, 8, 4]
    assert not {"architecture", "configuration", "code"} & key.keys()
    assert policy("{hidden: [16, 8, 4], architecture: pilotnet}").recipe == key
    assert policy("{}").network.described() == {"hidden": [200, 100, 20]}


def test_the_key_holds_what_the_network_reads_and_nothing_else():
    key = policy("{architecture: resnet, configuration: {blocks: 2}}").recipe
    assert key["configuration"] == {"widths": [24, 32, 48, 64], "blocks": 2, "hidden": 64}
    assert policy("{architecture: resnet, configuration: {blocks: 2}, hidden: [9, 9, 9]}").recipe == key
    assert policy("{architecture: resnet, configuration: {blocks: 2, hidden: 64}}").recipe == key
    assert policy("architecture: resnet").recipe != key


def test_a_users_class_counts_by_its_code_and_not_by_its_place(tmp_path):
    code = (EXAMPLES / "my_architecture.py").read_bytes()
    (tmp_path / "my_architecture.py").write_bytes(code)
    here, there = (
        policy("architecture: my_architecture.py:Mixer", folder) for folder in (EXAMPLES, tmp_path)
    )
    assert here.architecture != there.architecture
    assert here.recipe == there.recipe
    (tmp_path / "my_architecture.py").write_bytes(code + b"\n# changed\n")
    assert here.recipe != there.recipe


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (
            "architecture: resnt",
            r"a.yaml:1.*architecture: expected an architecture of pilotnet.*did you mean",
        ),
        ("architecture: none.py:Net", "expected a Python file at .*none.py"),
        ("configuration: {hidden: [1, 2, 3]}", "set hidden"),
        (
            "{architecture: resnet, configuration: {depth: 2}}",
            "configuration.depth: expected a setting of resnet",
        ),
    ],
)
def test_a_wrong_name_or_setting_is_an_error_of_the_file(text, message):
    with pytest.raises(ConfigError, match=message):
        policy(text)
