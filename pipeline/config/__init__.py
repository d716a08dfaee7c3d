"""Every tunable value, declared once: bounds, unit, title, step and one sentence.

From this declaration come the sliders, the REST schema, `--set stage.name=value`, the TOML file and
the table in README.
"""

from pipeline.config.declare import Stage
from pipeline.config.model import FieldSpec, Parameters, field_specs
from pipeline.config.presets import PRESETS, preset
from pipeline.config.text import assign, from_toml, markdown_table, to_toml

__all__ = [
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
