"""Stand figures of a mapped stand: stems per hectare, basal area, diameters, density, spatial pattern.

Pure computations: trees, plots and the observed area come in as arrays, results are records. Files are read
and written in `app.batch`.
"""

#: Expected standard deviation of a coordinate of a control point [m], unless the user gives another.
POINT_SIGMA = 0.125
