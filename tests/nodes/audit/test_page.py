"""What the page of an audit says."""

from pathlib import Path

from nodes.audit.page import write_page
from tests.support.audits import audit_result


def test_the_time_is_that_of_the_run_that_wrote_the_page(tmp_path: Path) -> None:
    """An audit that goes on in its folder reuses what earlier runs spent their time on."""
    page = write_page(tmp_path, audit_result(), {}, None, None, []).read_text(encoding="utf-8")
    assert "90 of 120 evaluations, 610 s in this run" in page
