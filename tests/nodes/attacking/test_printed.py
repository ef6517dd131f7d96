"""What is printed about the result of a search."""

from dataclasses import replace

from advnerf_core.driving.clean_drive import CleanDrive
from nodes.experiment.node.printed import in_one_line
from tests.support.faces import red_attack


def test_totals_with_and_without_an_attack_have_as_many_digits(tmp_path):
    clean = CleanDrive((0.012,), (0.001,), (0.002,), (False,), 10, 0.4)
    attack = replace(red_attack(tmp_path, "board")[0], predicted_total_cte_m=0.043, clean_drive=clean)
    assert in_one_line(attack).endswith("predicted total CTE 0.04 m, without attack 0.01 m")
