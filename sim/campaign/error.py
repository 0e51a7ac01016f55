"""The error that ends a campaign."""

from __future__ import annotations


class CampaignError(Exception):
    """The error of a campaign's folder, draws or data, with a one-line message."""
