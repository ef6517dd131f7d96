from pathlib import Path

import pytest

from benchmarks.demo_against import demo_command

OLD = "setup:\n\t@x\n\ndemo: stamp  ## The demo\n\t@echo hello\n\t@$(BIN)/advnerf experiment a.yaml --anew\n\nother:\n\t@$(BIN)/advnerf verify\n"


def test_the_command_is_that_of_the_target():
    assert demo_command(OLD) == ["experiment", "a.yaml", "--anew"]
    assert demo_command((Path(__file__).parents[2] / "Makefile").read_text()) == ["demo"]
    with pytest.raises(SystemExit, match="expected a Makefile whose target demo"):
        demo_command("demo:\n\t@true\n\nother:\n\t@$(BIN)/advnerf verify\n")
