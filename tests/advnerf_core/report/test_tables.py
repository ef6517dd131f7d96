import io
import json
from dataclasses import replace

import pytest
import rich.console

from advnerf_core.report.data import ReportData, Settings
from advnerf_core.report.tables import Table, find_row, transfer_rows


def report_of(make, runs):
    return ReportData(make.settings(), make.scene(), tuple(runs), make.manifest())


def run(make, domain, condition, total_m, seed=0, start=0, **changes):
    return replace(make.drive(domain, condition, 0.0, seed, start), total_cte_m=total_m, **changes)


def test_ratio_divides_by_no_attack_of_the_same_domain_and_start(make):
    runs = [
        run(make, "surrogate", "none", 2.0, start=0),
        run(make, "surrogate", "none", 4.0, start=1),
        run(make, "deployed", "none", 5.0, start=0),
        run(make, "surrogate", "gradient", 9.0, seed=0, start=0),
        run(make, "surrogate", "gradient", 11.0, seed=1, start=1),
        run(make, "deployed", "gradient", 20.0, start=0, off_track=True, time_to_leave_s=3.5),
        run(make, "deployed", "gradient", 10.0, start=0, off_track=False, time_to_leave_s=None),
    ]
    rows = transfer_rows(report_of(make, runs))
    surrogate, deployed = find_row(rows, "surrogate", "gradient"), find_row(rows, "deployed", "gradient")
    assert surrogate.ratio == pytest.approx((9.0 + 11.0) / (2.0 + 4.0))
    # Seeds: 9 / 2 = 4.5 and 11 / 4 = 2.75, sample standard deviation |4.5 - 2.75| / sqrt(2).
    assert surrogate.ratio_std == pytest.approx(1.75 / 2**0.5)
    assert surrogate.total_cte_mean_m == pytest.approx(10.0)
    assert surrogate.total_cte_std_m == pytest.approx(2**0.5)
    assert deployed.ratio == pytest.approx(3.0)
    assert (deployed.off_track, deployed.runs, deployed.time_to_leave_s) == (1, 2, 3.5)
    assert find_row(rows, "surrogate", "none").ratio == pytest.approx(1.0)
    assert find_row(rows, "deployed", "random") is None


def test_a_start_without_clean_drive_is_compared_with_the_mean_of_all(make):
    runs = [
        run(make, "deployed", "none", 2.0, start=0),
        run(make, "deployed", "none", 6.0, start=1),
        run(make, "deployed", "gradient", 12.0, start=2),
    ]
    assert find_row(transfer_rows(report_of(make, runs)), "deployed", "gradient").ratio == pytest.approx(3.0)


def test_without_clean_drives_there_is_no_ratio(make):
    row = transfer_rows(report_of(make, [run(make, "deployed", "gradient", 7.0)]))[0]
    assert (row.ratio, row.ratio_std, row.total_cte_std_m) == (None, None, None)


def test_victims_are_never_mixed(make):
    runs = [run(make, "surrogate", "none", 2.0), run(make, "surrogate", "none", 1.0, victim="naive")]
    runs += [run(make, "surrogate", "gradient", 8.0), run(make, "surrogate", "gradient", 8.0, victim="naive")]
    rows = transfer_rows(report_of(make, runs))
    assert find_row(rows, "surrogate", "gradient").ratio == pytest.approx(4.0)
    assert find_row(rows, "surrogate", "gradient", "naive").ratio == pytest.approx(8.0)


def test_the_table_shows_the_same_numbers_in_terminal_page_and_json(make):
    runs = [run(make, "surrogate", "none", 2.0), run(make, "surrogate", "gradient", 6.6)]
    rows = transfer_rows(report_of(make, runs))
    table = Table("Transfer", ("shown", "ratio"), (("gradient", f"{rows[1].ratio:.2f}"),), (False, True))
    terminal = io.StringIO()
    rich.console.Console(file=terminal, width=160).print(table.rich())
    assert "3.30" in terminal.getvalue()
    assert '<td class="number">3.30</td>' in table.html()
    assert json.loads(json.dumps(rows[1].record()))["ratio"] == pytest.approx(3.3)


def test_wrong_records_say_what_was_expected(make):
    with pytest.raises(ValueError, match=r"Run.condition to be a name, got ''"):
        replace(make.drive("deployed", "none", 0.0), condition="")
    good = make.drive("deployed", "none", 0.0)
    with pytest.raises(ValueError, match=r"Run.states as finite numbers \[61, 3\], got shape \(60, 3\)"):
        replace(good, states=good.states[:-1])
    with pytest.raises(ValueError, match=r"start_poses as finite numbers \[n, 3\]"):
        Settings("small", 40, 0.1, 30, 10, [[0.0, float("nan"), 0.0]], (0,), 0.8)
