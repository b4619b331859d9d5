"""Base of all settings: frozen pydantic models in which an unknown key is an error."""

from pydantic import BaseModel, ConfigDict


class Settings(BaseModel):
    """Settings of one stage. Each field has a default that works and a description with its unit.

    Every stage keeps its model beside its code; `geomocap.config` nests them into one TOML file.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)
