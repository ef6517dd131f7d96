"""A killed scene training ends as good as one that was left alone."""

from __future__ import annotations

import pytest

from tests.campaigns.campaign import Campaign
from tests.campaigns.scene_kill import STEPS, TOLERANCE_DB, kill_many


@pytest.mark.campaign
def test_killed_trainings_show_what_undisturbed_ones_show(campaign: Campaign) -> None:
    wanted = campaign.size(2, 20)
    undisturbed_db, differences_db = kill_many(wanted)
    worst_db, struck = max(differences_db, default=float("inf")), len(differences_db)
    good = sum(difference <= TOLERANCE_DB for difference in differences_db)
    campaign.record(
        "kill -9 at a random moment: scene training",
        f"{good}/{struck}",
        "within 0.1 dB",
        "20/20",
        good == struck >= 20,
        f"undisturbed {undisturbed_db:.2f} dB on held-out views; the worst differed by {worst_db:.4f} dB; SIGKILL at random "
        f"moments of {STEPS} steps, a checkpoint every 0.2 s",
    )
    assert (good, struck) == (wanted, wanted)
