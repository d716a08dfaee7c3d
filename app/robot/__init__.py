"""A robot that is heard live: what it sends, over which link, and whether it is still there."""
