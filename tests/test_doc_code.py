"""The check of the pages' Python finds names and arguments that are not there, and says where."""

import runpy
from pathlib import Path

import pytest

CHECK = runpy.run_path(str(Path(__file__).parents[1] / "docs" / "check_code.py"))
PAGE = """# A page

```python
from advnerf_core import Pinhole

pinhole = Pinhole(width=48, height=32, fx=30.0, fy=30.0, cx=24.0, cy=8.0)
drawn = a_renderer_of_yours(pinhole, ...)
```

```sh
from here import nothing
```

```python
from advnerf_core import Pinhole
from advnerf_core.geometry import no_such_name

pinhole = Pinhole(wide=48)
```
"""


def test_blocks_are_found_with_their_lines():
    assert list(CHECK["blocks"](PAGE)) == [4, 15]


@pytest.mark.slow
def test_what_does_not_fit_the_code_is_named_by_page_and_line():
    found = CHECK["faults"]({"docs/a.md": PAGE})
    assert [fault.split(": error: ")[0] for fault in found if "no_such_name" in fault] == ["docs/a.md:16"]
    assert [fault.split(": error: ")[0] for fault in found if '"wide"' in fault] == ["docs/a.md:18"]
    assert not [fault for fault in found if "a_renderer_of_yours" in fault]
