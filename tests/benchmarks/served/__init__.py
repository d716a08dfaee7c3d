"""The dashboard as a process, and who looks at it: for the benchmark `dashboard`."""
