"""Which parameters decide what a scan shows: where they are the same, what was kept holds."""

from __future__ import annotations

import hashlib
import json

from pipeline.config import Parameters

STAGES = ("acquisition", "filters", "ground", "clustering", "shape")
CLASSIFICATION = ("method", "every")  # which scans an overview is made of


def look_key(parameters: Parameters) -> bytes:
    """Sixteen bytes that differ where `pipeline.front_end.look` may give something else."""
    values = {
        **{stage: getattr(parameters, stage).model_dump() for stage in STAGES},
        "classification": parameters.classification.model_dump(include=set(CLASSIFICATION)),
    }
    return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).digest()[:16]
