"""Benchmarks, apart from the tests: `stemmap bench` runs them, pytest does not.

Each module of `cases` is one benchmark with `NAME`, `LINE` and `run() -> list[Table]`, and runs in a
process of its own.
"""
