"""Benchmarks, apart from the tests: `python -m tests.benchmarks` runs them, pytest does not.

Each module of `cases` is one benchmark with `NAME`, `LINE` and `run() -> list[Table]`, and runs in a
process of its own.
"""

import app.sources  # noqa: F401 - adds the formats of the extensions
