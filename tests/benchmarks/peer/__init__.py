"""The pipeline as a user would write it from the paper with libraries: Open3D, NumPy, filterpy, and a
FastSLAM in plain Python. It imports nothing of ours; `python -m tests.benchmarks peer` measures it beside
ours."""
