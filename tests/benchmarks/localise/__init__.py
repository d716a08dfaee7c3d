"""Drives for localisation in a stored map: simulated stands and the forests of Wild-Places."""
