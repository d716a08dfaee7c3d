"""Training of the random forest that classifies columns, from simulated, labelled and annotated scenes."""
