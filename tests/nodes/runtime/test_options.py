"""Options: what commands refuse in them."""

import pytest

from nodes.runtime.errors import ConfigError
from nodes.runtime.terminal import listen_address
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


@pytest.mark.parametrize("listen", ["localhost:99999", "127.0.0.1:65536"])
def test_a_port_that_does_not_exist_is_refused(listen):
    """viser said that it serves there."""
    with pytest.raises(ConfigError, match=rf"to listen on, got {listen}; write a port of at most 65535"):
        listen_address(listen)
    assert listen_address("localhost:65535") == ("localhost", 65535)
