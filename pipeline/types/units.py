"""Units of times."""

#: A second [ns].
SECOND_NS = 1_000_000_000
