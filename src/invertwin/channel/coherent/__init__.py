"""One realisation of the field: speckle, rough paths, physical optics, the radar equation."""
