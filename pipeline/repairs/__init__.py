"""Repairs of a map by a person: of trees, and of loops of the path.

The mapper does not know them. They are applied to its results, so that they can be undone and hold after the
run was mapped again.
"""
