"""The pipeline as a user would write it from the paper with libraries: Open3D, NumPy, filterpy, and a
FastSLAM in plain Python. It imports no module of stemmap; `python -m tests.benchmarks peer` compares both."""
