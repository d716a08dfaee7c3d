"""Hook of the build: a wheel takes the compiled kernels of this checkout along.

`python -m app.worker.numba_warmup` compiles them for the target that all machines share (`pipeline.jit`), and
`uv build --wheel` adds them where Numba looks for them. They are used by the same minor version of Python,
the same version of Numba and the same target; with others, kernels are compiled as from a clone.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface


class KernelsInWheel(BuildHookInterface):  # type: ignore[misc]
    """Adds the cache files of Numba, which hatchling leaves out like all files in __pycache__."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add them to the files of a wheel; the wheel of an editable installation needs none."""
        if version == "editable":
            return
        root = Path(self.root)
        for package in ("app", "pipeline"):
            for file in sorted((root / package).glob("**/__pycache__/*.nb[ci]")):
                source = file.parent.parent / f"{file.name.partition('.')[0]}.py"
                if source.exists():  # else a kernel of an earlier version
                    build_data["force_include"][str(file)] = file.relative_to(root).as_posix()
