"""What is said when a campaign cannot go on."""

from __future__ import annotations


class CampaignError(Exception):
    """One line: what is wrong with a campaign's folder, its draws or its data, and what to do."""
