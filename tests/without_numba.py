"""Plugin of pytest for NUMBA_DISABLE_JIT=1: kernels are plain functions, which have no cache."""

from __future__ import annotations

import pipeline.jit

setattr(pipeline.jit, "_keep_by_all_sources", lambda _kernel, _module: None)  # noqa: B010 - private
