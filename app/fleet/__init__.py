"""Several robots or runs at once: each has a dashboard with a worker and a map; one page shows all of
them."""
