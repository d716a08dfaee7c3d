"""Remapping: a run mapped again with other parameters, and the preview of its result."""
