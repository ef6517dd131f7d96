"""Methods of attack that users bring: the file of docs/methods.md, and a package as pip leaves it behind."""

from __future__ import annotations

import re
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

PAGE = Path(__file__).parents[2] / "docs" / "methods.md"


def spiral_code() -> str:
    """The method of the page."""
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return str(code)


def write_spiral(folder: Path) -> Path:
    """The method of the page as a file."""
    file = folder / "spiral.py"
    file.write_text(spiral_code())
    return file


def spiral_theta(
    shape: tuple[int, ...], number: int, seed: int = 0, turns: float = 0.1, growth: float = 0.2
) -> Tensor:
    """What the method of the page evaluates, by complex numbers."""
    across, up = torch.randn((2, *shape), generator=torch.Generator().manual_seed(seed), dtype=torch.float32)
    turned = torch.complex(across, -up) * torch.exp(torch.tensor(2j * torch.pi * turns * number))
    return growth * number * turned.real


def install_method(folder: Path, monkeypatch: pytest.MonkeyPatch, body: str, name: str = "spiral") -> None:
    """A package with one method, on the path of this process and of those that it starts."""
    (folder / "stranger_methods.py").write_text(body)
    info = folder / "stranger_methods-1.0.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: stranger-methods\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text(f"[advnerf.methods]\n{name} = stranger_methods:Spiral\n")
    monkeypatch.syspath_prepend(str(folder))
    monkeypatch.delitem(sys.modules, "stranger_methods", raising=False)
