"""Groups of options: what a command with them refuses."""

import pytest

from tests.support.commands import advnerf


@pytest.mark.parametrize(
    ("words", "option"),
    [
        (("train", "{folder}", "-o", "{folder}/out", "--box-low", "-inf", "0", "0"), "--box-low"),
        (("train", "{folder}", "-o", "{folder}/out", "--interval-px", "inf"), "--interval-px"),
        (("from-scan", "{folder}", "-o", "{folder}/out", "--length", "a", "b", "inf"), "--length"),
        (("from-scan", "{folder}", "-o", "{folder}/out", "--marker", "inf"), "--marker"),
    ],
)
def test_infinite_numbers_are_refused_with_the_option(tmp_path, monkeypatch, capsys, words, option):
    given = [word.format(folder=tmp_path) for word in words]
    assert advnerf(monkeypatch, "scene", *given) == 2
    assert f"expected finite numbers for {option}, got" in capsys.readouterr().err
    assert not list(tmp_path.iterdir())
