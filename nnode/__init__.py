"""nnode: calibrate interacting particle systems to measured trajectories."""

__version__ = "0.1.0"
