"""``advnerf doctor --gpu``, with the processor in place of a GPU, without one, and with a torch that only claims to have one."""

import pytest
import torch
from typer.testing import CliRunner

from advnerf_core.scene.agreement import PARTS
from nodes.cli.main import app
from tests.nodes.doctor.test_check import CUDA, library  # noqa: F401 - a fixture

pytestmark = pytest.mark.live


def test_all_parts_are_compared_and_the_text_can_be_pasted():
    done = CliRunner().invoke(app, ["doctor", "--gpu", "--gpu-device", "cpu"])
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert lines[0] == lines[-1] == "```"
    assert lines[1].startswith("advnerf ")
    assert f"torch {torch.__version__}" in done.output
    for part in PARTS:
        rows = [line for line in lines if line.startswith(part)]
        assert len(rows) == 2, part
        assert not [row for row in rows if "DIFFERS" in row or "FAILED" in row]
    assert lines[-2] == "searches with --device cuda use the GPU"
    assert max(map(len, lines)) < 120


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a device")
def test_without_a_gpu_it_is_one_line_and_a_failure():
    done = CliRunner().invoke(app, ["doctor", "--gpu"])
    assert done.exit_code == 1
    (line,) = done.output.splitlines()
    assert line.startswith(f"no GPU to compare: torch {torch.__version__}")


def test_a_torch_that_breaks_is_reported(library):  # noqa: F811
    library("torch", CUDA.format(gpus=1))
    done = CliRunner().invoke(app, ["doctor", "--gpu"])
    assert done.exit_code == 1
    assert "GPUs: H200" in done.output
    assert "searches with --device cuda use the processor" in done.output
