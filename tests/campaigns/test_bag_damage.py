"""No damage to a bag changes a number without a word. About five minutes in full."""

from __future__ import annotations

import pytest

from tests.campaigns.campaign import Campaign
from tests.support.bag_damage import cuts, flips


@pytest.mark.campaign
@pytest.mark.parametrize(
    ("damage", "what", "value"),
    [
        (cuts, "random truncations of bags with and without chunks", "kept other messages than an independent reader finds"),
        (flips, "random bit flips in bytes that a checksum covers", "changed a number silently"),
    ],
)  # fmt: skip
def test_no_damage_is_silent(campaign: Campaign, damage, what: str, value: str) -> None:
    count = campaign.size(200, 10_000)
    note = damage(count, 0)  # raises at the first silent damage
    campaign.record(f"{count:,} {what}", 0, value, "0; the damaged file is kept as it was", True, note)
