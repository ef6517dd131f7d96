"""A killed attack ends as if nothing had happened."""

from __future__ import annotations

import pytest

from tests.campaigns.attack_kill import EVALUATIONS, METHODS, kill_many
from tests.campaigns.campaign import Campaign


@pytest.mark.campaign
def test_killed_attacks_end_with_the_bytes_of_undisturbed_ones(campaign: Campaign) -> None:
    wanted = campaign.size(2, 20)
    same, struck = kill_many(wanted)
    campaign.record(
        "kill -9 at a random moment: attack",
        f"{same}/{struck}",
        "same bytes",
        "20/20",
        same == struck >= 20,
        f"{', '.join(METHODS)} in turns, SIGKILL at random moments of {EVALUATIONS} evaluations",
    )
    assert (same, struck) == (wanted, wanted)
