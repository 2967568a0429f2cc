"""What a campaign file says of its simulation."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class SimulationSettings(BaseModel):
    """Settings of a simulated campaign."""

    model_config = ConfigDict(extra="forbid", frozen=True)
