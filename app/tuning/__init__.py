"""The search for parameters: which ones, what for, over which runs, and what came of it."""
