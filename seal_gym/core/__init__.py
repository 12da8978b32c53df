"""Units, frames, configs and errors. Imports numpy, numba and the standard library only."""
