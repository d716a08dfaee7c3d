"""Kernels outside of the pipeline: their cached code is valid for the sources of both packages."""

from __future__ import annotations

from app.extensions.clouds.inventory import cross_sections
from pipeline import jit


def test_a_kernel_of_another_package_is_compiled_again_when_a_source_of_the_pipeline_changes(monkeypatch):
    module = cross_sections.__name__
    source, before = jit._source, jit.sources_digest(module)
    assert jit.sources_digest(module) == before
    for changed in ("pipeline.classification.voxel_map", module):
        monkeypatch.setattr(jit, "_source", lambda name, at=changed: source(name) + b"#" * (name == at))
        assert jit.sources_digest(module) != before
    monkeypatch.setattr(jit, "_source", lambda name: source(name) + b"#" * (name == "pipeline.mapper"))
    assert jit.sources_digest(module) == before, "which it does not import"
