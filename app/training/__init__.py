"""Training: the decision trees that say what a column is, grown anew from simulated and labelled scenes."""
