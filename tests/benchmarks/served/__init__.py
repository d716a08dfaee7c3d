"""The dashboard as a process, and its browsers, for the benchmark `dashboard`."""
