"""The section of a correlation between two draws, of a campaign or of a short form of one."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from maxq.sim.input.values import Section


class Correlated(Section):
    """Two draws of any continuous distributions with correlated normal scores (a Gaussian copula)."""

    of: tuple[str, str] = Field(description="names or key paths of two draws with continuous distributions")
    coefficient: Annotated[float, Field(ge=-1.0, le=1.0)] = Field(description="correlation coefficient of their scores")
