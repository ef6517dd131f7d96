"""What is published with the code is what its kept drives give."""

from pathlib import Path

import pytest

from advnerf_core.report.evidence.verify import sets_in, verify_set

PUBLISHED = Path(__file__).parents[1] / "docs" / "results"


def test_something_is_published():
    assert "room" in sets_in(PUBLISHED)


@pytest.mark.parametrize("name", sets_in(PUBLISHED))
def test_a_published_set_verifies(name):
    found = verify_set(PUBLISHED / name)
    assert found.problems == ()
    assert found.numbers > 0 or found.awaits_results
