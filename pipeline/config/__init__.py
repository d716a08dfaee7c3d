"""Parameters: each tunable value is declared once with bounds, unit, title, step and explanation.

The sliders, the REST schema, `--set stage.name=value`, the TOML file and docs/parameters.md derive from it.
"""

from pipeline.config.model import (
    FieldSpec,
    Parameters,
    assign,
    field_specs,
    from_toml,
    markdown_table,
    to_toml,
)
from pipeline.config.presets import OF_ONE_SENSOR, PRESETS, preset
from pipeline.config.stages import Stage

__all__ = [
    "OF_ONE_SENSOR",
    "PRESETS",
    "FieldSpec",
    "Parameters",
    "Stage",
    "assign",
    "field_specs",
    "from_toml",
    "markdown_table",
    "preset",
    "to_toml",
]
