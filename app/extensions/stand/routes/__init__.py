"""Routes of the plots, their figures and files, the reference system, and the comparison of two runs."""
