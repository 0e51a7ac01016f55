"""The error that ends a campaign."""

from __future__ import annotations


class CampaignError(Exception):
    """A one-line error in a campaign's folder, draws or data, with the next step."""
