"""Stories: why a cluster or a tree has its verdict, built when a browser requests them."""
