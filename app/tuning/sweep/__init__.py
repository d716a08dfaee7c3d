"""Many runs under many sets of parameters, on processes here or on the workers of a Dask cluster."""
