"""Several robots or runs at once: a dashboard each, with a worker and a map of its own; one page of all."""
