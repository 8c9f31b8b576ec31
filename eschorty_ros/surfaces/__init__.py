"""The geometry of clouds: organised grid, planes and distances, meshes, registration."""
